"""Group photographs by camera: by size, EXIF camera and lens, focal length, and folder.

A camera is one setting of one lens, with one set of intrinsics to estimate. A phone's lenses and
zoom settings give photographs of one size but need separate focal lengths. Too many cameras are
also harmful, since few photographs constrain focal length and distortion poorly; slightly different
zoom is one setting.

Notation: *focal lengths* in mm are 35 mm equivalents if EXIF has them, because digital zoom only
changes those.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import groupby, pairwise
from pathlib import PurePosixPath
from statistics import median_low
from typing import NamedTuple, TypeAlias

from PIL import Image as PilImage

from splatseed.findings import Finding
from splatseed.sfm.gps import GpsPosition
from splatseed.text import agreeing, counted, name_some

Size = tuple[int, int]
"""Width and height in stored pixels, before EXIF rotation."""

_MAKE, _MODEL, _IFD = 0x010F, 0x0110, 0x8769
_FOCAL, _FOCAL_35, _LENS, _ZOOM = 0x920A, 0xA405, 0xA434, 0xA404
_ROUNDING = 0.75
"""Largest rounding error of a 35 mm equivalent, which EXIF stores as an integer, mm."""
_SAME_RATIO = 1.01
"""Largest ratio of focal lengths of one setting."""
_NEAR_RATIO = 1.06
"""The same if either has few photographs."""
_MIN_GROUP = 4
"""Fewest photographs for a separate camera."""


MIN_DISTORTION = 16
"""Fewest photographs of which distortion is estimated, by default. Of captures without distortion,
OPENCV fits some that displaces corners by 3.2% of the width with 3 photographs, 1.6% with 6, 0.9%
with 9, 1.1% with 12 and 0.9% with 16 (medians of nine captures, then fewer), as much as a phone's
lens or more (docs/few_photographs.md)."""
MIN_FOCAL = 6
"""Fewest of which a focal length that EXIF has is estimated all the same: without distortion it is
off by 1.9% with 3 photographs and 1.2% with 6 (medians), but on fern by 16% with 3 and 4."""


class Exif(NamedTuple):
    """EXIF fields of the camera; empty or None if absent."""

    make: str = ""
    model: str = ""
    lens: str = ""
    focal: float | None = None  # mm
    focal_35: float | None = None  # mm, equivalent
    zoom: float | None = None  # digital zoom; some phones only change this


class Photo(NamedTuple):
    """The properties of a photograph; cameras are grouped by size and EXIF."""

    size: Size
    exif: Exif = Exif()
    digest: str = ""  # of the file's bytes
    gps: GpsPosition | None = None


Photos: TypeAlias = Mapping[str, Photo]
"""Photographs by name: the path relative to the images folder, with ``/``."""


class SharedCamera(NamedTuple):
    """Names of photographs that share a camera; ``typical`` has the median focal length."""

    names: tuple[str, ...]
    typical: str
    label: str  # such as "Apple iPhone 15 at 26 mm"; empty without EXIF


def read_exif(image: PilImage.Image) -> Exif:
    """Read the EXIF of an opened image; empty if damaged."""
    with suppress(Exception):  # Pillow raises any exception for truncated tags
        tags = image.getexif()
        own = tags.get_ifd(_IFD)
        texts = (_text(tags.get(_MAKE)), _text(tags.get(_MODEL)), _text(own.get(_LENS)))
        zoom = _length(own.get(_ZOOM))
        lengths = (_length(own.get(_FOCAL)), _length(own.get(_FOCAL_35)))
        return Exif(*texts, *lengths, None if zoom == 1 else zoom)
    return Exif()


def _text(value: object) -> str:
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return " ".join(value.replace("\0", " ").split()) if isinstance(value, str) else ""


def _length(value: object) -> float | None:
    """Return a tag's value in mm; None for 0 (unknown) and 0 / 0."""
    with suppress(TypeError, ValueError, ArithmeticError):
        length = float(value)  # type: ignore[arg-type]  # others raise
        return length if 0 < length < math.inf else None
    return None


def share_cameras(photos: Photos) -> tuple[SharedCamera, ...]:
    """Group photographs by camera, in the order of each camera's first photograph.

    Photographs share a camera if size, make, model and lens are equal, focal lengths are nearly
    equal, and folders are equal (folders with few photographs are merged).
    """
    lengths = _focal_lengths(photos)
    groups: list[list[str]] = []
    for alike in _grouped(photos, lambda name: (photos[name].size, *_lens_of(photos[name]))):
        for known in _grouped(alike, lambda name: lengths[name] is not None):
            for setting in _settings(known, lengths):
                groups += _by_folder(setting)
    groups = sorted(map(sorted, _merge_without_exif(groups, photos)))
    return tuple(_shared(names, photos, lengths) for names in groups)


def default_model(count: int) -> str:
    """Return COLMAP's camera model for a number of photographs: without distortion for few."""
    return "OPENCV" if count >= MIN_DISTORTION else "SIMPLE_PINHOLE"


def held_lens(count: int, *, focal: bool) -> Finding:
    """Return the finding that few photographs do not determine the lens."""
    what = "the focal length is EXIF's" if focal else "only the focal length is estimated"
    text = f"{count} photographs do not determine a lens: it is taken to have no distortion, and "
    fix = f"`camera_model='OPENCV'` estimates all of it, the default from {MIN_DISTORTION} on."
    return Finding("held-lens", f"{text}{what}.", "info", fix=fix)


def describe_cameras(cameras: Sequence[SharedCamera]) -> str:
    """Describe the number and kinds of cameras."""
    labels = [
        f"{camera.label or 'unnamed'} ({counted(len(camera.names), 'photograph')})"
        for camera in cameras
    ]
    number = counted(len(cameras), "camera")
    if not any(camera.label for camera in cameras):
        how = agreeing(len(cameras), "for all", "by size and folder")
        return f"{number} {how}: EXIF names none"
    return f"{number} by EXIF: {name_some(labels)}"


def _lens_of(photo: Photo) -> tuple[object, ...]:
    exif = photo.exif
    return exif.make, exif.model, exif.lens, exif.zoom


def _focal_lengths(photos: Photos) -> dict[str, float | None]:
    """Return focal lengths, more precise than rounded equivalents where possible."""
    found: dict[str, float | None] = {}
    for names in _grouped(photos, lambda name: _lens_of(photos[name])):
        both = [photos[name].exif for name in names]
        crops = [e.focal_35 / e.focal for e in both if e.focal and e.focal_35]
        crop = median_low(crops) if crops else 1.0
        for name in names:
            exif = photos[name].exif
            exact = exif.focal * crop if exif.focal else None
            rounded = exif.focal_35 or exact
            # A phone's other lens or digital zoom changes the equivalent.
            differ = exact is None or rounded is None or abs(exact - rounded) > _ROUNDING
            found[name] = rounded if differ else exact
    return found


def _settings(names: Sequence[str], lengths: Mapping[str, float | None]) -> list[list[str]]:
    """Group photographs of one lens by focal length."""
    groups = [
        list(same)
        for _, same in groupby(sorted(names, key=lambda n: lengths[n] or 0.0), lengths.__getitem__)
    ]
    while len(groups) > 1:  # merge neighbours, most similar first
        spans = [(lengths[b[-1]] or 1.0) / (lengths[a[0]] or 1.0) for a, b in pairwise(groups)]
        joined = [
            (span, i)
            for i, span in enumerate(spans)
            if span <= _SAME_RATIO
            or (span <= _NEAR_RATIO and min(map(len, groups[i : i + 2])) < _MIN_GROUP)
        ]
        if not joined:
            break
        i = min(joined)[1]
        groups[i : i + 2] = [groups[i] + groups[i + 1]]
    return groups


def _by_folder(names: Sequence[str]) -> list[list[str]]:
    folders = _grouped(names, lambda name: PurePosixPath(name).parent)
    rest = [name for each in folders if len(each) < _MIN_GROUP for name in each]
    return [*(each for each in folders if len(each) >= _MIN_GROUP), *([rest] if rest else [])]


def _merge_without_exif(groups: Sequence[list[str]], photos: Photos) -> list[list[str]]:
    """Merge few photographs without EXIF into the only other camera of their size."""
    kept = [list(each) for each in groups]
    for group in groups:
        size, exif = photos[group[0]][:2]
        others = [each for each in kept if photos[each[0]].size == size and each != group]
        if len(group) < _MIN_GROUP and exif == Exif() and len(others) == 1:
            kept.remove(group)
            others[0] += group
    return kept


def _shared(
    names: Sequence[str], photos: Photos, lengths: Mapping[str, float | None]
) -> SharedCamera:
    known = sorted((length, name) for name in names if (length := lengths[name]) is not None)
    length, typical = known[len(known) // 2] if known else (None, names[0])
    exif = photos[typical].exif
    model = exif.model if exif.model.startswith(exif.make) else f"{exif.make} {exif.model}"
    label = " at ".join(filter(None, [model.strip(), f"{length:.3g} mm" if length else ""]))
    return SharedCamera(tuple(names), typical, label)


def _grouped(names: Iterable[str], key: Callable[[str], object]) -> list[list[str]]:
    groups: dict[object, list[str]] = {}
    for name in names:
        groups.setdefault(key(name), []).append(name)
    return list(groups.values())
