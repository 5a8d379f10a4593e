"""A photograph's file: its bytes, its size, its pixels.

Promise: pixels are as stored, before any EXIF rotation, because COLMAP counts them so; transparent
ones are composited over black, the background of renders; 16-bit grey, and floats in [0, 1], are
rounded to 8 bits, and 16-bit colours keep their upper 8 (Pillow's way); every failure names the
file.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.files import other_spelling, read_file
from splatseed.literal import told
from splatseed.scene import Scene

if TYPE_CHECKING:
    from PIL import Image as PilImage

_CHECK_SCALE = 8
"""JPEGs are checked at an eighth of their size: all bytes are read, few pixels are computed."""
_WIDE_GREY = ("I", "F")
"""Pillow's modes for one channel of more than 8 bits, which its own conversion clips at 255."""
_INKS = ("CMYK", "LAB")
"""Pillow's modes that are not RGB or grey; it would convert inks by a rule of thumb."""
_DECODER_FAILURES = (OSError, ValueError, SyntaxError)


def photograph_folder(scene: Scene) -> Path:
    """The folder that a scene's photographs are in.

    Raises:
        SceneNotFoundError: The scene has no images, or no folder of them.
    """
    folder = scene.source.image_dir if scene.source else None
    if folder is None or not scene.images:
        raise SceneNotFoundError(
            "a scene with photographs",
            found="no images" if folder else "no folder of images",
            fix="Name a scene with cameras, and put its photographs into a folder named images.",
        )
    return folder


def photograph_bytes(path: Path) -> bytes:
    """The file's bytes.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It cannot be read.
    """
    try:
        return read_file(path)
    except FileNotFoundError:
        near = other_spelling(path)
        raise SceneNotFoundError(
            f"the image {path}",
            found=f"{near} in its place" if near else "no such file",
            fix="Name it as the model does, to the letter."
            if near
            else "Put it there, or drop it from the model.",
        ) from None
    except OSError as error:
        raise _unusable(path, error.strerror or type(error).__name__) from None


def open_photograph(path: Path, encoded: bytes) -> PilImage.Image:
    """The photograph in a file's bytes; only its header is decoded yet.

    Raises:
        SceneFormatError: It is no image.
    """
    from PIL import Image, UnidentifiedImageError  # noqa: PLC0415  (slow to import)

    try:
        return Image.open(BytesIO(encoded))
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError) as error:
        raise _unusable(path, told(error)) from None


def decode_photograph(path: Path, encoded: bytes) -> PilImage.Image:
    """The pixels in a file's bytes, as RGB.

    Raises:
        SceneFormatError: It is no image, is cut short or damaged, is in inks (CMYK), or has numbers
            of unknown range.
    """
    photograph = open_photograph(path, encoded)
    if photograph.mode in _INKS:
        raise SceneFormatError(
            f"{path} to be in RGB or grey",
            found=photograph.mode,
            fix="Export it as sRGB: the look of its colours depends on a printer's profile.",
        )
    if photograph.mode.startswith(_WIDE_GREY):
        return _eight_bits(path, photograph).convert("RGB")
    try:
        if "A" in photograph.getbands() or "transparency" in photograph.info:
            return _over_black(photograph.convert("RGBA"))
        return photograph.convert("RGB")
    except _DECODER_FAILURES as error:
        raise _damaged(path, error) from None


def check_photograph(path: Path) -> tuple[int, int]:
    """Read a photograph to its last byte, keep nothing, and return its width and height.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is no image, or is cut short or damaged.
    """
    photograph = open_photograph(path, photograph_bytes(path))
    size = photograph.size
    photograph.draft(None, (size[0] // _CHECK_SCALE, size[1] // _CHECK_SCALE))
    try:
        photograph.load()
    except _DECODER_FAILURES as error:
        raise _damaged(path, error) from None
    return size


def _eight_bits(path: Path, photograph: PilImage.Image) -> PilImage.Image:
    """Grey of 16 bits or of floats, as 8 bits."""
    from PIL import Image  # noqa: PLC0415  (loads with its use)

    try:
        values = np.asarray(photograph)
    except _DECODER_FAILURES as error:
        raise _damaged(path, error) from None
    most = 1.0 if photograph.mode == "F" else 65535.0
    # 32-bit integers can have any range; some versions of Pillow open 16-bit PNGs as such.
    known = photograph.mode != "I" or photograph.format == "PNG"
    if not (known and values.min() >= 0 and values.max() <= most):  # NaN compares false
        raise SceneFormatError(
            f"{path} to have 8 or 16 bits a channel, or floats of 0 to 1",
            found=f"{values.dtype} from {values.min():g} to {values.max():g}",
            fix="Export the photograph with 8 bits a channel.",
        )
    grey = np.rint(values.astype(np.float32) * np.float32(255 / most)).astype(np.uint8)
    transparent = photograph.info.get("transparency")
    if transparent is not None:
        grey[values == transparent] = 0
    return Image.fromarray(grey)


def _over_black(photograph: PilImage.Image) -> PilImage.Image:
    from PIL import Image  # noqa: PLC0415  (loads with its use)

    black = Image.new("RGBA", photograph.size, (0, 0, 0, 255))
    return Image.alpha_composite(black, photograph).convert("RGB")


def _damaged(path: Path, error: Exception) -> SceneFormatError:
    return _unusable(path, f"an image cut short or damaged ({told(error)})")


def _unusable(path: Path, found: str) -> SceneFormatError:
    return SceneFormatError(
        f"{path} to be an image", found=found, fix="Copy or export the image again."
    )
