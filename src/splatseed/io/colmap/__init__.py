"""COLMAP models: both forms of their files, and the scenes they hold."""
