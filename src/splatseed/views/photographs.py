"""Photographs as pixels: decoded, made smaller by a whole factor, and kept for the next run.

Promise: a smaller copy is the mean over f x f blocks, rounded (pixels at the right and lower edge
that do not fill a block are cut off), so intrinsics are divided by f and nothing else changes; it
is looked up by the content of the original, so a changed photograph is never mistaken for the old
one. Only ``cache_dir`` is written to, and a failure to write there is ignored.
"""

from __future__ import annotations

import hashlib
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from splatseed.errors import OutputError, ParameterError, SceneFormatError
from splatseed.io.output.staging import atomic_file
from splatseed.io.photograph import decode_photograph, open_photograph, photograph_bytes

if TYPE_CHECKING:
    from PIL import Image as PilImage

FILTER = "box-2"
"""Part of the key: change it whenever the downsampling changes."""


def load_photograph(
    path: Path, factor: int = 1, cache_dir: Path | None = None
) -> tuple[UInt8[np.ndarray, "H W 3"], tuple[int, int]]:
    """The pixels of an image file, downsampled by ``factor``, and the file's width and height.

    Transparent pixels are laid over black, which Gaussians are drawn on.

    Args:
        path: The image.
        factor: 1 or more; a block of factor x factor pixels becomes one.
        cache_dir: Where smaller copies are kept; nowhere when left out.

    Raises:
        ParameterError: The factor is less than 1.
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is no image, or too small for the factor.
    """
    if factor < 1:
        raise ParameterError(
            "--data-factor of 1 or more", found=f"{factor}", fix="Images are never enlarged."
        )
    encoded = photograph_bytes(path)
    kept = None if cache_dir is None or factor == 1 else cache_dir / _key(encoded, factor)
    if kept is not None and kept.is_file():
        with suppress(SceneFormatError):  # a damaged copy is made again
            photograph = decode_photograph(kept, photograph_bytes(kept))
            return np.array(photograph), open_photograph(path, encoded).size
    original = decode_photograph(path, encoded)
    photograph = _reduce(path, original, factor)
    if kept is not None:
        _keep(photograph, kept)
    return np.array(photograph), original.size


def user_cache_dir() -> Path:
    """Where this user's programs cache files (not created here)."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "splatseed" / "images"


def _key(encoded: bytes, factor: int) -> str:
    digest = hashlib.blake2b(encoded, digest_size=16, person=FILTER.encode())
    return f"{digest.hexdigest()}_{factor}.png"


def _reduce(path: Path, original: PilImage.Image, factor: int) -> PilImage.Image:
    if factor == 1:
        return original
    width, height = original.width // factor, original.height // factor
    if not width or not height:
        raise SceneFormatError(
            f"{path} to be larger than --data-factor {factor}",
            found=f"{original.width} x {original.height}",
            fix="Choose a smaller --data-factor.",
        )
    return original.reduce(factor, (0, 0, width * factor, height * factor))


def _keep(photograph: PilImage.Image, path: Path) -> None:
    with suppress(OutputError, OSError):  # a cache that cannot be written is done without
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as partial:
            photograph.save(partial, compress_level=1)
