"""Numba kernels of the CPU rasteriser, a file per stage."""
