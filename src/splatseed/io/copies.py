"""Photographs that are copies of others: the same bytes under another name.

A copy of a test image must not be trained on, whatever the split: only one of equals is kept.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np

from splatseed.errors import SplatseedError
from splatseed.findings import Finding
from splatseed.io.files import open_file
from splatseed.scene import Image, Scene
from splatseed.text import agreeing, counted

COPIES = "copied-photographs"
_PROBE = 4096
"""Bytes from the middle of a file that are compared before all of them."""
_PART = 1 << 20
"""Bytes that are read at a time."""
_PLAIN = 0.02
"""Bytes per pixel of a picture that may show nothing, as which many photographs can be equal."""
_ONE_COLOR = 2
"""Range of the values of a picture that shows nothing: lossy formats round."""
_HEADERS = 1000
"""Bytes of a picture besides its pixels."""


def without_copies(scene: Scene) -> Scene:
    """Return a scene without photographs that are copies of others; they become ``absent``."""
    groups = [[image for image in scene.images if image.has_photograph]]
    for key in (_size, _probe, _digest):
        groups = [part for group in groups for part in _equal(group, key)]
    test = scene.listed.test if scene.listed else frozenset[str]()
    originals = dict[str, str]()
    for group in groups:
        if not _is_plain(group[0]):
            names = [image.name for image in group]
            names.sort(key=lambda name: (name not in test, len(name), name))
            originals |= dict.fromkeys(names[1:], names[0])
    if not originals:
        return scene
    copy, original = next(iter(originals.items()))
    are = agreeing(len(originals), "is a copy of another", "are copies of others")
    text = f"{counted(len(originals), 'photograph')} {are} and left out, such as {copy} of "
    finding = Finding(COPIES, f"{text}{original}.", subjects=tuple(originals))
    return scene.without(originals).replace(findings=(*scene.findings, finding))


def _equal(images: Iterable[Image], key: Callable[[Path], Hashable]) -> list[list[Image]]:
    """Group images whose files have the same key, without those that are alone."""
    groups = defaultdict[Hashable, list[Image]](list)
    for image in images:
        with suppress(OSError):  # reported where its pixels are needed
            groups[key(image.path)].append(image)
    return [group for group in groups.values() if len(group) > 1]


def _size(path: Path) -> int:
    return path.stat().st_size


def _probe(path: Path) -> bytes:
    with open_file(path) as file:
        file.seek(_size(path) // 2)
        return file.read(_PROBE)


def _digest(path: Path) -> bytes:
    digest = hashlib.blake2b()
    with open_file(path) as file:
        while part := file.read(_PART):
            digest.update(part)
    return digest.digest()


def _is_plain(image: Image) -> bool:
    """Whether a photograph is unreadable, or of one colour."""
    if image.size is None:
        return True
    if _size(image.path) >= _HEADERS + _PLAIN * image.size[0] * image.size[1]:
        return False
    try:
        return int(np.ptp(image.read().reshape(-1, 3), axis=0).max()) <= _ONE_COLOR
    except SplatseedError:  # reported where its pixels are needed
        return True
