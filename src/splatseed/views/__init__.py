"""Photographs at a size with their cameras, and what each of them sees."""
