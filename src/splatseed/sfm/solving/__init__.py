"""Poses and points from verified matches: mapping, triangulation, refinement of given poses."""
