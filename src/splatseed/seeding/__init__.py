"""Seeding: as many seeds as asked for, where the photographs need them.

Import from the modules, so that none is loaded before it is needed.
"""
