"""Photographs at a size, with their cameras: the input of depth, stereo, seeding and training.

``view`` reads a scene's images as pinhole views, ``visibility`` tells which points each sees, and
``pairs`` which to compare.
"""
