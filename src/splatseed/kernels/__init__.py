"""What compiled code stands on: Numba's settings, its cache's key, vectors of 16 floats."""
