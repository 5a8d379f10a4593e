"""Read photographs: bytes, size and pixels.

Promise: pixels are as stored, without EXIF rotation, as in COLMAP; transparent pixels are
composited over the background of renders, which is black but for models of trainers with another,
or, where they are masked, of the background up to half of the full alpha and of their own colour
from there on; 16 bits per channel and floats in [0, 1] are rounded to 8 bits, with the capture's
*white* (``io.picture``) as 255.
"""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8, UInt16
from PIL import Image as PilImage

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io.files import read_bytes, similar_name, translate_errors
from splatseed.io.picture import WHITE, is_16_bit, opaque_value, open_picture, read_16_bit
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scene import BLACK, Color, Image, Scene

_CHECK_SCALE = 8
"""JPEGs are checked at 1/8 of their size: all bytes are read, few pixels are computed."""
_WIDE_GREY = ("I", "F")
"""Pillow's modes for one channel of more than 8 bits, which Pillow's conversion clips at 255."""
_WITH_ALPHA = (2, 4)
"""Numbers of channels of which the last is alpha."""
_INKS = ("CMYK", "LAB")
"""Pillow's modes other than RGB and grey; Pillow ignores colour profiles when converting."""
OPAQUE = 128
"""Alpha of 255 from which on a pixel shows something, rather than nothing."""
COPY_AGAIN = "Copy or export the image again."
_COMPLETE_IMAGE = "an image, neither truncated nor damaged"


def photograph_folder(scene: Scene) -> Path:
    """Return the folder of a scene's photographs; raise ``SceneNotFoundError`` without any."""
    folder = scene.source.image_dir
    if folder is None or not scene.images:
        raise SceneNotFoundError(
            "a scene with photographs",
            found="no images" if folder else "no folder of images",
            fix="Choose a scene with poses (in COLMAP models, images.bin), and put its photographs "
            "into a folder named images.",
        )
    return folder


def photographs_digest(scene: Scene) -> str:
    """Fingerprint lenses, poses and the sizes of the photographs' files.

    A run keeps it, so that a scene that has changed since is noticed.
    """
    parts = []
    for image in scene.images:
        lens = image.lens
        size = image.path.stat().st_size if image.has_photograph else None
        facts = f"{image.name!r} {lens.params} {lens.width} {lens.height} {size}"
        parts.append(facts.encode())  # repr escapes what is no UTF-8 in a name
        parts.append(image.quat.tobytes() + image.translation.tobytes())
    return fingerprint(*parts)


def photograph_bytes(path: Path) -> bytes:
    """Read a photograph's file; raises as read_bytes, with advice for a missing file."""
    try:
        return read_bytes(path)
    except SceneNotFoundError:
        found, fix = "no such file", "Restore it, or remove it from the model."
        if near := similar_name(path):
            found, fix = f"only {near}", "Rename it to the exact name in the model."
        raise SceneNotFoundError(f"the image {path}", found=found, fix=fix) from None


def open_photograph(path: Path, encoded: bytes) -> PilImage.Image:
    """Open encoded bytes as a photograph; only the header is decoded."""
    with translate_errors(path, "an image", fix=COPY_AGAIN):
        return open_picture(BytesIO(encoded))


def decode_photograph(
    path: Path,
    encoded: bytes,
    white: int = WHITE,
    *,
    composited: bool = True,
    background: Color = BLACK,
) -> PilImage.Image:
    """Decode a photograph to RGB; in 16 bits, ``white`` becomes 255.

    Transparent pixels are ``composited`` over the background, or of its colour below ``OPAQUE`` and
    else opaque.

    Raises:
        SceneFormatError: No image, truncated or damaged, CMYK or LAB, or of unknown value range.
    """
    photograph = open_photograph(path, encoded)
    if photograph.mode in _INKS:
        raise SceneFormatError(
            f"{path} to be in RGB or grey",
            found=photograph.mode,
            fix="Export it as sRGB: CMYK and LAB colours depend on a profile.",
        )
    if photograph.mode.startswith(_WIDE_GREY):
        return _grey_of(path, photograph, white, background)
    with translate_errors(path, _COMPLETE_IMAGE, fix=COPY_AGAIN):
        if is_16_bit(photograph):
            return _colors_of(
                read_16_bit(encoded), photograph, white, background, composited=composited
            )
        if has_alpha(photograph):
            behind = PilImage.new("RGBA", photograph.size, (*background, 255))
            shown = photograph.convert("RGBA")
            if not composited:
                shown.putalpha(shown.getchannel("A").point(lambda alpha: 255 * (alpha >= OPAQUE)))
            return PilImage.alpha_composite(behind, shown).convert("RGB")
        if photograph.mode == "RGB":  # converting would copy it, which takes as long as decoding
            photograph.load()
            return photograph
        return photograph.convert("RGB")


def read_photograph(
    path: Path, white: int = WHITE, *, composited: bool = True, background: Color = BLACK
) -> UInt8[np.ndarray, "H W 3"]:
    """The pixels of a file, at its size; errors as ``photograph_bytes`` and ``decode_photograph``.

    ``white`` is the value that becomes 255 in a file of 16 bits a channel; ``composited`` and
    ``background`` as there.
    """
    encoded = photograph_bytes(path)
    return np.array(
        decode_photograph(path, encoded, white, composited=composited, background=background)
    )


def read_transparent(path: Path) -> Bool[np.ndarray, "H W"] | None:
    """Read which pixels have an alpha below ``OPAQUE``; None if none can have."""
    if path.suffix.lower() in {".jpg", ".jpeg"}:  # never transparent: skip reading
        return None
    encoded = photograph_bytes(path)
    photograph = open_photograph(path, encoded)
    if not has_alpha(photograph) or photograph.mode.startswith(_WIDE_GREY):
        return None
    with translate_errors(path, _COMPLETE_IMAGE):
        if is_16_bit(photograph):
            values = read_16_bit(encoded)
            if values.shape[-1] not in _WITH_ALPHA:  # transparent by one colour
                return np.asarray(np.all(values == photograph.info["transparency"], axis=-1))
            alpha = values[..., -1]
            return np.asarray(alpha < opaque_value(alpha) * np.float32(OPAQUE / 255))
        return np.asarray(np.asarray(photograph.convert("RGBA").getchannel("A")) < OPAQUE)


def has_alpha(photograph: PilImage.Image) -> bool:
    """Whether an image can have transparent pixels."""
    return "A" in photograph.getbands() or "transparency" in photograph.info


def check_photograph(path: Path) -> tuple[int, int]:
    """Decode a photograph completely to find damage; return its width and height."""
    photograph = open_photograph(path, photograph_bytes(path))
    size = photograph.size
    photograph.draft(None, (size[0] // _CHECK_SCALE, size[1] // _CHECK_SCALE))
    with translate_errors(path, _COMPLETE_IMAGE, fix=COPY_AGAIN):
        photograph.load()
    return size


def _colors_of(
    values: UInt16[np.ndarray, "H W C"],
    photograph: PilImage.Image,
    white: int,
    background: Color,
    *,
    composited: bool,
) -> PilImage.Image:
    """Convert 16-bit colours or grey to RGB over the background."""
    channels = values.shape[-1]
    colors = values[..., : channels - (channels in _WITH_ALPHA)]
    shown = np.minimum(colors.astype(np.float32) * np.float32(255 / white), 255)
    if channels in _WITH_ALPHA:
        opacity = values[..., -1] / np.float32(opaque_value(values[..., -1]))
        if not composited:
            opacity = (opacity >= OPAQUE / 255).astype(np.float32)
        shown = shown * opacity[..., None] + (1 - opacity[..., None]) * np.array(
            background, np.float32
        )
    transparent = photograph.info.get("transparency")
    if isinstance(transparent, tuple):
        shown[(colors == transparent).all(axis=-1)] = background
    pixels = np.rint(shown).astype(np.uint8)
    return PilImage.fromarray(np.ascontiguousarray(np.broadcast_to(pixels, (*pixels.shape[:2], 3))))


def _grey_of(
    path: Path, photograph: PilImage.Image, white: int, background: Color
) -> PilImage.Image:
    """Convert 16-bit or float grey to RGB."""
    with translate_errors(path, _COMPLETE_IMAGE, fix=COPY_AGAIN):
        values = np.asarray(photograph)
    limit = 1.0 if photograph.mode == "F" else 65535.0
    # 32-bit integers have no known range, but some versions of Pillow open 16-bit PNGs so.
    known = photograph.mode != "I" or photograph.format == "PNG"
    if not (known and values.min() >= 0 and values.max() <= limit):  # NaN compares false
        raise SceneFormatError(
            f"{path} to have 8 or 16 bits per channel, or floats from 0 to 1",
            found=f"{values.dtype} from {values.min():g} to {values.max():g}",
            fix="Export the photograph with 8 bits per channel.",
        )
    scale = np.float32(255 / (1.0 if photograph.mode == "F" else white))
    grey = np.rint(np.minimum(values.astype(np.float32) * scale, 255)).astype(np.uint8)
    pixels = np.repeat(grey[..., None], 3, axis=2)
    transparent = photograph.info.get("transparency")
    if transparent is not None:
        pixels[values == transparent] = background
    return PilImage.fromarray(pixels)


def lens_findings(images: Sequence[Image]) -> list[Finding]:
    """Report lens distortion, which not every trainer supports."""
    models = sorted({im.intrinsics.model for im in images if im.intrinsics.has_distortion})
    if not models:
        return []
    lenses = f"Cameras have lens distortion ({', '.join(models)})"
    trainers = "splatseed train, graphdeco's trainer and OpenSplat need PINHOLE cameras"
    text = f"{lenses}; {trainers}: undistort the scene with splatseed undistort SCENE -o OUT."
    return [Finding("lens-distortion", text)]
