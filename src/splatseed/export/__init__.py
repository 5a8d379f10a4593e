"""Trained Gaussians in the file formats of viewers and engines: one module per format."""

from splatseed.export.formats import FORMATS, SUFFIXES, detect_format, format_of_name
from splatseed.export.model import read_model, write_model
from splatseed.export.selection import Crop, check_opacity, keep_gaussians, parse_crop

__all__ = [
    "FORMATS",
    "SUFFIXES",
    "Crop",
    "check_opacity",
    "detect_format",
    "format_of_name",
    "keep_gaussians",
    "parse_crop",
    "read_model",
    "write_model",
]
