"""This process and its children: memory, tasks here or on a cluster, and children's interpreter."""
