"""Depth-guided lifting: turning pixels of the photographs into points by their depth maps.

Promise: photographs and maps are read one at a time by each thread, whatever the number of images.
"""
