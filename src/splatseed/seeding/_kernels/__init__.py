"""Numba kernels of seeding, a file per subject."""
