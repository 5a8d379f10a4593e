"""Seeding: new points where the photographs need them, within a budget.

The package itself loads none of its modules.
"""
