"""Reading and writing scenes, a file or folder per format.

``load_scene`` detects the format of a path; ``write_scene`` writes a folder that every 3D Gaussian
Splatting trainer loads unchanged; ``find_depths`` finds the depth maps of a scene's images. Bad
input and failed output raise one error from ``splatseed.errors``.
"""

import lazy_loader

# The names, with their types, stand in __init__.pyi; each is loaded when it is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
