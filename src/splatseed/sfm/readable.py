"""Copies of photographs that pycolmap would read differently from splatseed.

pycolmap divides 16 bits per channel by 257, although a capture may use only 10 or 12 of them, of
which four or sixteen grey levels remain; and it drops transparency, so that an undistorted copy
shows the colours of transparent pixels. Both are read right by ``decode_photograph``.
"""

from __future__ import annotations

from collections.abc import Container, Iterable
from pathlib import Path

import numpy as np

from splatseed.io.bit_depth import WHITE, find_white, is_16_bit
from splatseed.io.image_folders import link_folders
from splatseed.io.photograph import decode_photograph, has_alpha, open_photograph, photograph_bytes

COPIES = "readable"
"""Folder of a run's scratch folder with such copies."""
_SUFFIXES = frozenset({".png", ".tif", ".tiff", ".webp"})  # with 16 bits or transparency


def copy_misread(
    image_dir: Path,
    names: Iterable[str],
    folder: Path,
    *,
    over_black: bool = False,
    linked: Container[str] = (),
) -> Path:
    """Copy photographs that pycolmap misreads to ``folder``, with links to the others.

    Args:
        image_dir: The photographs.
        names: Their names.
        folder: A folder to create if there is any to copy. Copies have 8 bits per channel.
        over_black: Copy photographs with transparent pixels, too.
        linked: Names of photographs that pycolmap only copies.

    Returns:
        The folder for pycolmap: ``folder``, or ``image_dir`` if there is nothing to copy.
    """
    paths = {name: image_dir / name for name in names}
    white, _ = find_white(list(paths.values()))
    read = [n for n, path in paths.items() if n not in linked and path.suffix.lower() in _SUFFIXES]
    odd = [name for name in read if _is_misread(paths[name], white, over_black=over_black)]
    if not odd:
        return image_dir
    link_folders({n: path for n, path in paths.items() if n not in odd}, folder, copy=False)
    for name in odd:
        copy = folder / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        picture = decode_photograph(paths[name], photograph_bytes(paths[name]), white)
        picture.save(copy, lossless=True)  # of WebP; PNG and TIFF are
    return folder


def _is_misread(path: Path, white: int, *, over_black: bool) -> bool:
    picture = open_photograph(path, photograph_bytes(path))
    if is_16_bit(picture) and white != WHITE:
        return True
    if not (over_black and has_alpha(picture)):
        return False
    return bool(np.asarray(picture.convert("RGBA").getchannel("A")).min() < WHITE // 257)
