"""Open pictures with Pillow, with size and pixels as stored.

Pillow turns the pixels of TIFF files, and of no others, by their orientation when it decodes them.
COLMAP does not, so that the photographs would not fit their poses.
"""

from __future__ import annotations

from pathlib import Path
from typing import IO, Any

from PIL import Image as PilImage
from PIL.ImageFile import ImageFile
from PIL.TiffImagePlugin import IMAGELENGTH, IMAGEWIDTH, TiffImageFile

ORIENTATION = 0x0112
"""EXIF's tag, and TIFF's."""
UPRIGHT = 1


def open_picture(file: IO[bytes] | Path, formats: tuple[str, ...] | None = None) -> ImageFile:
    """Open a picture of one of some formats (None: any); only its header is decoded."""
    picture = PilImage.open(file, formats=formats)
    if isinstance(picture, TiffImageFile) and picture.getexif().get(ORIENTATION) is not None:
        picture.getexif()[ORIENTATION] = UPRIGHT  # by which Pillow turns the pixels
        # Pillow has no public way to set the size, which it has swapped (test_picture.py).
        stored: Any = picture
        stored._size = (stored.tag_v2[IMAGEWIDTH], stored.tag_v2[IMAGELENGTH])  # noqa: SLF001
    return picture
