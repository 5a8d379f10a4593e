"""Reading and writing scenes."""
