"""splatseed: better seeds for 3D Gaussian Splatting.

>>> import splatseed as ss
>>> sorted(ss.METHODS)[:3]
['auto', 'cloud', 'cover']
"""

import lazy_loader

# The names, with their types, stand in __init__.pyi; each is loaded when it is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
