"""The base of compiled code: Numba's settings, the key of its cache, vectors of 16 floats."""
