"""Numba kernels of the methods that interpolate, a file per subject."""
