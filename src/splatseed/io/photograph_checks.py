"""Check that photographs exist and fit their camera records.

A photograph *fits* its camera if it has its size or is a resized copy. Sizes are of stored pixels,
as in COLMAP: EXIF orientation is ignored. Only headers are read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image as PilImage

from splatseed.camera import Intrinsics
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io.files import absolute, open_file, similar_name, special_kind, translate_errors
from splatseed.io.photograph import COPY_AGAIN, photograph_bytes, photograph_folder
from splatseed.io.picture import ORIENTATION, UPRIGHT, open_picture
from splatseed.io.recordings import is_extracted
from splatseed.io.staging import read_manifest
from splatseed.scene import Image, Scene
from splatseed.text import agreeing, counted, name_some

Size = tuple[int, int]
"""Width and height."""

ASPECT_SLACK = 0.02
"""Largest relative difference in aspect ratio between a resized copy and its camera."""
ROUNDING = 2.0
"""Pixels by which a side may be off after resizing; rounding gives 1 at most."""
MAX_OFF_CENTER = 0.2
"""Distance of a principal point from the image centre along both axes, as shares of the size, that
suggests another size: half the pixels put it at a quarter, twice at the corner."""
MIN_FOCAL = 0.05
"""Smallest plausible focal length of a perspective camera, in image sizes: 169 degrees."""
_SIDEWAYS = frozenset({5, 6, 7, 8})
"""EXIF orientations that swap width and height."""
ORIENTATIONS = "orientations"
"""Manifest entry: by name, EXIF orientations of photographs whose copies are marked as upright."""
_NAMED = 3  # photographs listed in a message


def with_photographs(scene: Scene) -> Scene:
    """Drop images without a photograph; they become ``absent``.

    Raises:
        SceneNotFoundError: Fewer than half of the photographs exist.
    """
    folder = photograph_folder(scene)
    missing = tuple(image.name for image in scene.images if not image.has_photograph)
    if not missing:
        return scene
    if 2 * len(missing) > len(scene.images):
        raise SceneNotFoundError(
            f"at least half of the scene's {len(scene.images)} photographs in {folder}",
            found=f"{len(scene.images) - len(missing) or 'none'}; "
            f"missing: {name_some(missing, _NAMED)}{_hint(missing[0], folder, scene.images)}",
            fix="Copy them there, with the names of the model.",
        )
    return scene.without(missing)


def photograph_size(path: Path) -> Size:
    """Read width and height of an image file, once for each version of it."""
    if not path.is_file():
        photograph_bytes(path)  # raises with advice for a missing file
    with translate_errors(path, "an image", fix=COPY_AGAIN):
        state = path.stat()
        return _size_in_header(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=1 << 16)
def _size_in_header(path: Path, *_version: int) -> Size:
    with open_file(path) as file:
        return open_picture(file).size


def fits(lens: Intrinsics, size: Size) -> bool:
    """Whether a photograph of this size has its camera's size or is a resized copy."""
    record = (lens.width, lens.height)
    if size == record[::-1] != record:  # rotated, even if nearly square
        return False
    stretch = size[0] * lens.height / (size[1] * lens.width)
    return abs(stretch - 1) <= ASPECT_SLACK or _off(lens, size) <= ROUNDING / 2


def _off(lens: Intrinsics, size: Size) -> float:
    """Return how far a photograph's size is from that of a resized copy, px."""
    width, height = size[1] * lens.width / lens.height, size[0] * lens.height / lens.width
    return min(abs(size[0] - width), abs(size[1] - height))


def check_sizes(images: Sequence[Image]) -> dict[str, Size]:
    """Return the sizes of photographs by name, once all are found to fit their cameras.

    Raises:
        SceneNotFoundError: One is missing.
        SceneFormatError: One does not fit, or is not an image.
    """
    sizes = {image.name: image.size or photograph_size(image.path) for image in images}
    wrong = [image for image in images if not fits(image.intrinsics, sizes[image.name])]
    if wrong:
        lens, (width, height) = wrong[0].intrinsics, sizes[wrong[0].name]
        reason, fix = _misfit(wrong[0], (width, height))
        more = len(wrong) - 1
        others = f"; {more} more of {counted(len(images), 'photograph')} do not fit either"
        raise SceneFormatError(
            f"{wrong[0].path} to have the size of its camera {lens.camera_id}, "
            f"{lens.width} x {lens.height}, or to be a resized copy",
            found=f"{width} x {height}: {reason}{others if more else ''}",
            fix=fix,
        )
    return sizes


def _misfit(image: Image, size: Size) -> tuple[str, str]:
    if not fits(image.intrinsics, size[::-1]):
        return "cropped, or stretched", (
            "Use the photographs of the reconstruction, or resized copies. A crop "
            "needs a camera record of its own: width, height and principal point."
        )
    if (orientation := exif_orientation(image.path)) in _SIDEWAYS:
        return f"stored rotated, with EXIF orientation {orientation}", (
            "The poses are for upright pixels: rotate copies as EXIF says (ImageMagick: mogrify "
            "-auto-orient), or estimate poses for the files as stored (splatseed sfm)."
        )
    return "rotated, with width and height swapped", (
        "Rotate them back, or estimate poses for the files as stored (splatseed sfm)."
    )


def exif_orientation(path: Path) -> int:
    """Return EXIF's orientation of a photograph, 1 to 8; 0 if it has none, or cannot be read."""
    try:
        with open_file(path) as file, PilImage.open(file) as picture:
            return int(picture.getexif().get(ORIENTATION, 0))
    except Exception:  # noqa: BLE001  (damaged EXIF makes Pillow raise anything)
        return 0


def original_orientation(image: Image) -> int:
    """Return the EXIF orientation of a photograph, or of the one that ``sfm`` copied upright."""
    found = exif_orientation(image.path)
    if found > UPRIGHT or image.folder is None:
        return found
    recorded = read_manifest(image.folder.resolve().parent).get(ORIENTATIONS)
    return recorded.get(image.name, found) if isinstance(recorded, dict) else found


def photograph_findings(
    images: Sequence[Image], image_dir: Path | None, root: Path
) -> list[Finding]:
    """Find missing photographs, and cameras that do not fit their sizes; drops none."""
    if not images:
        return []
    odd = _odd_cameras(images)
    if image_dir is None:
        dead = root / "images" if (root / "images").is_symlink() else None
        missing = (
            f"{dead} links to {dead.readlink()}, which does not exist" if dead else "is missing"
        )
        text = f"The images folder {missing}; points can be made, but not trained."
        return [Finding("missing-photographs", text), *odd]
    images = [replace(image, folder=image_dir) for image in images]
    absent = {im.name: None for im in images if not im.has_photograph}
    findings = [_missing([*absent], images, image_dir)] if absent else []
    # Links are not followed: users make them on purpose.
    around = absolute(root)
    outside = [im.name for im in images if around not in absolute(im.path).parents]
    if outside and not is_extracted(image_dir):
        lie = agreeing(len(outside), "lies", "lie")
        text = f"{len(outside)} of {len(images)} images {lie} outside of {root}"
        text += f", such as {outside[0]}."
        findings.append(Finding("photographs-outside-scene", text, subjects=tuple(outside)))
    findings += odd
    return [*findings, *_size_findings([im for im in images if im.name not in absent])]


def _odd_cameras(images: Sequence[Image]) -> list[Finding]:
    odd = [image for image in images if _is_of_another_size(image.intrinsics)]
    if not odd:
        return []
    lens = odd[0].intrinsics
    fx, fy, cx, cy = lens.pinhole.params
    of = f"{len(odd)} of {counted(len(images), 'image')}"
    what = f"The focal lengths and principal point of {of} are probably not in pixels of this size"
    such = f"({fx:.4g}, {fy:.4g}) and ({cx:.4g}, {cy:.4g}) in {lens.width} x {lens.height}"
    return [
        Finding(
            "intrinsics-of-another-size",
            f"{what}: {such} for {odd[0].name}.",
            subjects=tuple(image.name for image in odd),
            fix="State the width and height that they belong to.",
        )
    ]


def _is_of_another_size(lens: Intrinsics) -> bool:
    """Whether intrinsics do not fit the image size, as after resizing, or if they are fractions."""
    size = np.array([lens.width, lens.height])
    right, below = lens.K[:2, 2] / size - 0.5
    off = min(abs(right), abs(below)) if right * below > 0 else 0.0
    too_wide = not lens.is_fisheye and min(lens.K[[0, 1], [0, 1]] / size) < MIN_FOCAL
    return bool(off > MAX_OFF_CENTER or too_wide)


def _missing(missing: Sequence[str], images: Sequence[Image], image_dir: Path) -> Finding:
    are = agreeing(len(missing), "is", "are")
    subject = f"{len(missing)} of {len(images)} images {are} missing in {image_dir}, and left out"
    text = f"{subject} ({name_some(missing, _NAMED)}){_hint(missing[0], image_dir, images)}."
    return Finding("missing-photographs", text, subjects=tuple(missing))


def _hint(first: str, image_dir: Path, images: Sequence[Image]) -> str:
    """Explain why a photograph is missing: one of another suffix, case or folder may exist."""
    near, kind = similar_name(image_dir / first), special_kind(image_dir / first)
    if near is None:
        alike = [p for p in image_dir.rglob("*") if p.name == PurePosixPath(first).name]
        names = {path.relative_to(image_dir).as_posix() for path in alike}
        near = min(names - {image.name for image in images}, default=None)
    hint = f"; {near} exists, but names must match exactly" if near else ""
    hint = f"; {first} is {kind}" if kind else hint
    return "; separate folders by /, not by \\" if "\\" in first else hint


def _size_findings(images: Sequence[Image]) -> list[Finding]:
    """Describe each kind of mismatch between files and cameras, with the first example."""
    sizes, findings = {im.name: im.size for im in images if im.size}, list[Finding]()
    if len(sizes) < len(images):
        first = next(image for image in images if not image.size)
        try:
            photograph_size(first.path)
        except SceneFormatError as error:
            text = f"{first.name} cannot be read: {error.found}."
            findings.append(Finding("unreadable-photograph", text, subjects=(first.name,)))
    other = [im for im in images if sizes.get(im.name, _own(im)) != _own(im)]
    fitting = [im for im in other if fits(im.intrinsics, sizes[im.name])]
    stretched = [im for im in fitting if _off(im.intrinsics, sizes[im.name]) > ROUNDING]
    all_of = counted(len(images), "photograph")
    if wrong := [im for im in other if im not in fitting]:
        reason, fix = _misfit(wrong[0], sizes[wrong[0].name])
        text = (
            f"{len(wrong)} of {all_of} {agreeing(len(wrong), 'does', 'do')} not fit the camera: "
            f"{_against(wrong[0], sizes)} ({reason}). They cannot be used for training."
        )
        names = tuple(image.name for image in wrong)
        findings.append(Finding("photographs-do-not-fit", text, "error", names, fix))
    if stretched:
        (width, height), lens = sizes[stretched[0].name], stretched[0].intrinsics
        stretch = abs(width * lens.height / (height * lens.width) - 1)
        have = agreeing(len(stretched), "has", "have")
        text = (
            f"{len(stretched)} of {all_of} {have} another aspect ratio than the camera: "
            f"{_against(stretched[0], sizes)}. They count as resized and stretched by "
            f"{stretch:.1%}; if they were cropped, give them a camera of their own size."
        )
        names = tuple(image.name for image in stretched)
        findings.append(Finding("photographs-stretched", text, subjects=names))
    elif fitting:
        text = f"{_against(fitting[0], sizes)}; some trainers rescale, others fail."
        names = tuple(image.name for image in fitting)
        findings.append(Finding("photographs-resized", text, subjects=names))
    return findings


def _own(image: Image) -> Size:
    return image.intrinsics.width, image.intrinsics.height


def _against(image: Image, sizes: Mapping[str, Size]) -> str:
    lens, size = image.intrinsics, sizes[image.name]
    record = f"its camera {lens.camera_id} {lens.width} x {lens.height}"
    return f"{image.name} has {size[0]} x {size[1]} pixels, {record}"
