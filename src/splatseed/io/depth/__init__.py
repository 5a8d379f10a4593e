"""Depth maps in files: every format that is read, and folders of them."""
