"""Output that trainers load: its layouts, what is ours in it, and how it comes to be there whole."""
