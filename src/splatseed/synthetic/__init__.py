"""A synthetic capture with known surfaces, for the demo, the tests and the benchmarks.

``make_capture`` photographs a small room by ray casting and finds points in the photographs as
Structure-from-Motion would; ``SHAPES`` holds single surfaces to measure a method on.
"""

from splatseed.synthetic.capture import DEPTH_SCALE, Capture, make_capture, write_capture
from splatseed.synthetic.shapes import SHAPES
from splatseed.synthetic.surfaces import Surface

__all__ = ["DEPTH_SCALE", "SHAPES", "Capture", "Surface", "make_capture", "write_capture"]
