"""Depth and normal maps from photographs alone, on the CPU.

Promise: NumPy, SciPy and Numba only; importing this package loads none of them.
"""

import lazy_loader

# The names, with their types, stand in __init__.pyi; each is loaded when it is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
