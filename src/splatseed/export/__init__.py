"""Trained Gaussians in the file formats of viewers and engines."""

from splatseed.export.formats import (
    FORMATS,
    SUFFIXES,
    Crop,
    check_opacity,
    detect_format,
    format_of_name,
    keep_gaussians,
    parse_crop,
    read_model,
    write_model,
)

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
