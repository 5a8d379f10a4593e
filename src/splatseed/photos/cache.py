"""Downsampled photographs, cached.

A smaller copy is the mean over blocks of factor x factor pixels, rounded. Copies are cached by the
content of the original; a failure to write the cache is ignored.
"""

from __future__ import annotations

import hashlib
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from platformdirs import user_cache_path

from splatseed.errors import OutputError, ParameterError
from splatseed.io.bit_depth import WHITE
from splatseed.io.files import ARCHIVE_FAILURES, StrPath, read_npy
from splatseed.io.photograph import decode_photograph, photograph_bytes
from splatseed.io.staging import atomic_file
from splatseed.photos.sizes import check_side

FILTER = "box-3"  # part of the cache's key: change it whenever downsampling changes


def load_photograph(
    path: StrPath, factor: int = 1, cache_dir: Path | None = None, white: int = WHITE
) -> UInt8[np.ndarray, "H W 3"]:
    """Read a photograph, downsampled by ``factor``.

    Transparent pixels are laid over black, the background of renders. Smaller copies are cached in
    ``cache_dir``, if there is one.
    """
    path = Path(path)
    if factor < 1:
        raise ParameterError(
            "`data_factor` of 1 or more", found=f"{factor}", fix="Images are never enlarged."
        )
    encoded = photograph_bytes(path)
    digest = hashlib.blake2b(encoded, digest_size=16, person=FILTER.encode()).hexdigest()
    kept = (
        None if cache_dir is None or factor == 1 else cache_dir / f"{digest}_{factor}_{white}.npz"
    )
    if kept is not None and (known := _read(kept)) is not None:
        return known
    original = decode_photograph(path, encoded, white)
    width, height = original.width // factor, original.height // factor
    check_side(path, 1, factor, (width, height))
    photograph = original
    if factor > 1:
        photograph = original.reduce(factor, (0, 0, width * factor, height * factor))
    pixels = np.array(photograph)
    if kept is not None:
        with suppress(OutputError, OSError):  # a cache that cannot be written is done without
            kept.parent.mkdir(parents=True, exist_ok=True)
            with atomic_file(kept) as partial, partial.open("wb") as file:
                np.savez(file, photograph=pixels)
    return pixels


def _read(path: Path) -> UInt8[np.ndarray, "H W 3"] | None:
    """Read a cached copy; None if unusable.

    It is not compressed: reading a PNG takes longer than decoding a JPEG of twice its size.
    """
    if not path.is_file():
        return None
    # A damaged one is made again. Not by np.load: views are read in threads.
    with (
        suppress(*ARCHIVE_FAILURES),
        zipfile.ZipFile(path) as archive,
        archive.open("photograph.npy") as file,
    ):
        return read_npy(file)
    return None


def user_cache_dir() -> Path:
    """Return the folder in which downsampled photographs are cached; it may not exist yet."""
    return user_cache_path("splatseed", appauthor=False) / "images"
