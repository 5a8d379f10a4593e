"""Stereo's Numba kernels: photometric cost, PatchMatch, and comparisons between views' maps."""
