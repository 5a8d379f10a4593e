"""Depth maps in files: every readable format, and folders of maps."""
