"""What compiled code stands on: Numba's settings, its cache's key, and vectors of sixteen floats."""
