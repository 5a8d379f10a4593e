"""Photographs at a size, with their cameras; which points each sees, and which views to compare."""
