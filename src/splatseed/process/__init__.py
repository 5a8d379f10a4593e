"""This process and its children: memory, and the interpreter that children run in."""
