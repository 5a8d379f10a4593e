"""A synthetic capture with known surfaces, for the demo, tests and benchmarks.

``make_capture`` renders photographs of a small room by ray casting and simulates Structure-from-
Motion points; ``SHAPES`` are single surfaces on which methods are measured.
"""

from splatseed.synthetic.capture import DEPTH_SCALE, Capture, make_capture, write_capture
from splatseed.synthetic.surfaces import SHAPES, Surface

__all__ = ["DEPTH_SCALE", "SHAPES", "Capture", "Surface", "make_capture", "write_capture"]
