"""Panoramas: which photographs are some, and the faces and scenes that are cut from them.

A face is named after its panorama, ``front_NAME``, so that faces of one direction follow one
another by name as the panoramas do.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool
from PIL import Image as PilImage

from splatseed.camera import PANORAMA, Intrinsics, quat_from_rotation
from splatseed.errors import ParameterError
from splatseed.findings import Finding
from splatseed.io.files import open_file
from splatseed.io.image_folders import link_folders
from splatseed.io.masks import read_mask
from splatseed.io.photograph import (
    open_photograph,
    photograph_bytes,
    photograph_folder,
    read_alpha,
    read_photograph,
)
from splatseed.photos.panorama import FACES, cut_face, face_directions, face_features, face_lens
from splatseed.progress import Progress, num_threads
from splatseed.scene import MIN_HELD_OUT, TEST_EVERY, Image, Masks, Scene, SceneSource, Split
from splatseed.sfm.cameras import Photos
from splatseed.text import agreeing, counted, name_some
from splatseed.tracks import Observations, Tracks

_JPEG_QUALITY = 95
_MAX_MASKED = 80.0  # degrees from straight down
_HEAD_BYTES = 1 << 18  # of a file, in which its XMP is
_GPANO = re.compile(rb"GPano:(\w+)\s*(?:=\s*[\"']|>)\s*(\w+)")
_SIZES = (("CroppedAreaImageWidthPixels", "FullPanoWidthPixels"),
          ("CroppedAreaImageHeightPixels", "FullPanoHeightPixels"))  # fmt: skip
_CHECKED_WIDTH = 1024
_NEAR, _MAX_STEP = 6, 2.0
"""Columns beside each side, and how many times the difference of two of them the sides' may be: at
most 0.9 in panoramas as cameras save them, 1.8 in resampled ones; 3 and more in crops of other
photographs."""
_ALIKE, _MAX_UNIFORM = 8.0, 0.8  # distance from the side's median, and the share of such pixels
PanoramasName: TypeAlias = Literal["auto", "all", "none"]


class Cut(NamedTuple):
    """The photographs of a scene with faces in place of its panoramas."""

    folder: Path  # of the photographs
    faces: dict[str, list[str]]  # names of each panorama's, without those that are masked whole
    masks: Masks | None


class PanoramaRig(NamedTuple):
    """Panoramas of one size, whose faces are the cameras of a rig."""

    first_id: int  # of the rig and its first camera; the others' follow in the order of ``FACES``
    lens: Intrinsics  # of the faces
    faces: tuple[tuple[str, ...], ...]  # names of each panorama's, in the order of ``FACES``

    @property
    def camera_ids(self) -> dict[str, int]:
        """The camera of each face, by the face's name."""
        order = list(FACES)
        return {
            name: self.first_id + order.index(PurePosixPath(name).name.partition("_")[0])
            for names in self.faces
            for name in names
        }


def face_names(name: str) -> list[str]:
    """Return the names of a panorama's faces, in the order of ``FACES``."""
    path = PurePosixPath(name)
    return [str(path.with_name(f"{face}_{path.name}")) for face in FACES]


def cut_photographs(
    image_dir: Path,
    panoramas: Mapping[str, Intrinsics],
    others: Collection[str],
    folder: Path,
    *,
    masks: Masks | None = None,
    mask_below: float = 0.0,
    white: int = 65535,
    progress: Progress,
) -> Cut:
    """Write the faces of panoramas to ``folder``, with links to the other photographs.

    Args:
        image_dir: The folder of the photographs.
        panoramas: The camera of each panorama, by name.
        others: Names of the other photographs.
        folder: A folder to create, for photographs and masks.
        masks: Masks of the photographs.
        mask_below: Angle around straight down, in degrees, within which panoramas are masked.
        white: The value of white in photographs of 16 bits a channel.
        progress: Called with the share of panoramas done.
    """
    images = folder / "images"
    images.mkdir(parents=True)
    if taken := {*others} & {face for name in panoramas for face in face_names(name)}:
        raise ParameterError(
            "no other photographs with the names of the panoramas' parts",
            found=name_some(sorted(taken), 3),
            fix="Leave out either the panoramas or what was cut from them.",
        )
    link_folders({name: image_dir / name for name in others}, images, copy=False)
    files = {} if masks is None else {n: p for n, p in masks.files.items() if n not in panoramas}
    inverted = masks is not None and masks.inverted
    own = None if masks is None else replace(masks, alpha=False)

    def cut(name: str) -> tuple[list[str], dict[str, Path]]:
        lens, path = panoramas[name], image_dir / name
        pixels, alpha = read_photograph(path, white, composited=False), read_alpha(path)
        counts, names, written = read_mask(own, name, path), list[str](), dict[str, Path]()
        for face, face_name in zip(FACES, face_names(name), strict=True):
            shown = _mask_of(lens, face, counts, mask_below)
            if not shown.any():
                continue
            names.append(face_name)
            picture = PilImage.fromarray(cut_face(pixels, lens, face))
            if alpha is not None:
                picture.putalpha(PilImage.fromarray(cut_face(_grey(alpha), lens, face)[..., 0]))
            target = images / face_name
            target.parent.mkdir(parents=True, exist_ok=True)
            picture.save(target, quality=_JPEG_QUALITY, subsampling=0, lossless=True)
            if not shown.all():
                written[face_name] = folder / "masks" / f"{face_name}.png"
                written[face_name].parent.mkdir(parents=True, exist_ok=True)
                PilImage.fromarray(shown != inverted).save(written[face_name])
        return names, written

    faces: dict[str, list[str]] = {}
    with ThreadPoolExecutor(num_threads()) as pool:
        for name, (names, masked) in zip(panoramas, pool.map(cut, panoramas), strict=True):
            faces[name] = names
            files |= masked
            progress("panoramas", len(faces) / len(panoramas))
    if masks is None:
        return Cut(images, faces, Masks(files) if files else None)
    return Cut(images, faces, replace(masks, files=files))


def _grey(values: np.ndarray) -> np.ndarray:
    return np.repeat(values[..., None], 3, axis=2)


def _mask_of(
    panorama: Intrinsics, face: str, counts: Bool[np.ndarray, "H W"] | None, mask_below: float
) -> Bool[np.ndarray, "S S"]:
    """Return which pixels of a face count: those of which all source pixels do."""
    lens = face_lens(panorama)
    shown = np.ones((lens.height, lens.width), np.bool_)
    if counts is not None:
        grey = cut_face(_grey(np.where(counts, 255, 0).astype(np.uint8)), panorama, face)
        shown &= grey[..., 0] == 255
    if mask_below > 0:
        xyz = face_directions(lens, face, slice(0, lens.height))
        down = xyz[..., 1] / np.linalg.norm(xyz, axis=-1)
        shown &= down < math.cos(math.radians(mask_below))
    return shown


def check_mask_below(degrees: float, panoramas: Collection[str]) -> None:
    """Raise ``ParameterError`` unless an angle to be masked fits, and there are panoramas."""
    if not 0 <= degrees <= _MAX_MASKED:
        expected = f"`mask_below` from 0 to {_MAX_MASKED:g} degrees"
        raise ParameterError(expected, found=f"{degrees:g}", fix="Try 30.")
    if degrees and not panoramas:
        raise ParameterError("panoramas with `mask_below`", found="none", fix="Leave it out.")


def find_panoramas(
    image_dir: Path, photos: Photos, choice: PanoramasName = "auto"
) -> tuple[dict[str, Intrinsics], tuple[Finding, ...]]:
    """Find the panoramas among photographs, with their cameras, and report them.

    With ``auto`` these are the photographs twice as wide as high that say so in their XMP (GPano),
    or, of those of one size, all if most go on from their right side to their left.

    Raises:
        ParameterError: All are to be panoramas, and one is not twice as wide as high.
    """
    if choice == "none":
        return {}, ()
    wide = [name for name, photo in photos.items() if photo.size[0] == 2 * photo.size[1]]
    odd = sorted(photos.keys() - {*wide})
    if choice == "all" and odd:
        width, height = photos[odd[0]].size
        raise ParameterError(
            "panoramas of all directions, twice as wide as high, with `panoramas='all'`",
            found=f"{odd[0]} of {width} x {height}",
            fix="Remove the photographs that are not panoramas, or leave `panoramas` out.",
        )
    findings: list[Finding] = []
    stated = dict.fromkeys(wide, True)
    if choice == "auto":
        given = {name: _stated(image_dir / name) for name in photos}
        stated = {name: is_whole for name, is_whole in given.items() if is_whole is not None}
        open_sides = {name for name in wide if stated.get(name) is False}
        for size in {photos[name].size for name in wide if name not in stated}:
            alike = [name for name in wide if photos[name].size == size and name not in stated]
            # No photograph of another kind closes, but an object at a panorama's side may hide it.
            if 2 * sum(_closes(image_dir / name) for name in alike) <= len(alike):
                open_sides |= {*alike}
        wide = [name for name in wide if name not in open_sides]
        if parts := sorted(name for name in stated if name not in wide):
            text = f"{counted(len(parts), 'panorama')} of some directions ({name_some(parts, 3)})"
            how = f"{text} {agreeing(len(parts), 'is', 'are')} used as perspective photographs."
            findings = [Finding("panoramas", how, subjects=tuple(parts), fix="Remove them.")]
    if not wide:
        return {}, tuple(findings)
    lenses = {
        n: Intrinsics(1, PANORAMA.name, *(s := photos[n].size), tuple(map(float, s))) for n in wide
    }
    why = (
        "by their XMP"
        if stated.keys() >= {*wide}
        else "twice as wide as high, and closed at the sides"
    )
    text = f"{counted(len(wide), 'panorama')} ({why if choice == 'auto' else 'as chosen'})"
    fix = "`panoramas='none'` takes them for perspective photographs." if choice == "auto" else ""
    return lenses, (cut_finding(text, lenses, fix), *findings)


def cut_finding(what: str, lenses: Mapping[str, Intrinsics], fix: str = "") -> Finding:
    """Report that panoramas are cut."""
    sides = sorted({face_lens(lens).width for lens in lenses.values()})
    size = " or ".join(f"{side} x {side}" for side in sides)
    each = agreeing(len(lenses), "is", "are each")
    text = f"{what} {each} cut into {len(FACES)} photographs of {size} px."
    return Finding("panoramas", text, "info", tuple(lenses), fix)


def _stated(path: Path) -> bool | None:
    """Whether a photograph's XMP states a panorama of all directions; None without any panorama."""
    with open_file(path) as file:
        tags = {
            key.decode(): value.decode() for key, value in _GPANO.findall(file.read(_HEAD_BYTES))
        }
    if "ProjectionType" not in tags:
        return None
    whole = all(tags.get(cropped) == tags.get(full) for cropped, full in _SIZES)
    return whole and tags["ProjectionType"].lower() == "equirectangular"


def _closes(path: Path) -> bool:
    """Whether the sides of a photograph join: they differ as neighbouring columns near them do.

    Sides that are nearly uniform, such as the black ones of a pair of fisheyes, or a studio's
    white, join as well and do not count.
    """
    with open_photograph(path, photograph_bytes(path)) as picture:
        width = min(picture.width, _CHECKED_WIDTH)
        picture.draft("L", (width, width // 2))  # JPEG keeps colours in blocks
        pixels = np.asarray(picture.convert("L").resize((width, width // 2)), np.float64)
    near = np.roll(pixels, _NEAR, axis=1)[:, : 2 * _NEAR]
    steps = np.abs(np.diff(near, axis=1)).mean(axis=0)
    side = pixels[:, 0]
    uniform = np.abs(side - np.median(side)) < _ALIKE
    others = np.delete(steps, _NEAR - 1).mean()
    return bool(steps[_NEAR - 1] <= _MAX_STEP * others + 1 and uniform.mean() < _MAX_UNIFORM)


def rigs_of(
    panoramas: Mapping[str, Intrinsics], faces: Mapping[str, Sequence[str]], first_id: int
) -> tuple[PanoramaRig, ...]:
    """Return a rig for each size of panorama; ids start at ``first_id``."""
    return tuple(
        PanoramaRig(
            first_id + number * len(FACES),
            face_lens(lens),
            tuple(
                tuple(faces[name]) for name in panoramas if panoramas[name] == lens and faces[name]
            ),
        )
        for number, lens in enumerate(dict.fromkeys(panoramas.values()))
    )


def cut_scene(scene: Scene, folder: Path, mask_below: float, progress: Progress) -> Scene:
    """Return a scene with faces in place of its panoramas, whose photographs are in ``folder``.

    Its photographs exist, and its cameras are in their pixels. A feature goes to the face that
    shows it best.
    """
    whole = {im.name: im.intrinsics for im in scene.images if im.intrinsics.is_panorama}
    if not whole:
        return scene
    image_dir = photograph_folder(scene)
    others = [image.name for image in scene.images if image.name not in whole]
    cut = cut_photographs(
        *(image_dir, whole, others, folder),
        masks=scene.masks,
        mask_below=mask_below,
        white=scene.white,
        progress=progress,
    )
    free = itertools.count(1 + max(image.intrinsics.camera_id for image in scene.images))
    lenses = {lens: face_lens(lens, next(free)) for lens in dict.fromkeys(whole.values())}
    made: list[Image] = []
    moved: list[tuple[int, np.ndarray, np.ndarray]] = []
    for image in scene.images:
        first = len(made) + 1
        if image.name not in whole:
            made.append(replace(image, image_id=first))
            count = len(image.observations or ())
            moved.append((image.image_id, np.full(count, first), np.arange(count)))
            continue
        seen = image.observations or Observations(np.empty((0, 2)), np.empty(0, np.int64))
        face, xy = face_features(image.intrinsics, seen.xy)
        index = np.empty(len(seen), np.int64)
        turns = zip(face_names(image.name), FACES.values(), strict=True)
        for number, (name, turn) in enumerate(turns):
            mine = np.flatnonzero(face == number)
            index[mine] = np.arange(len(mine))
            made.append(
                replace(
                    image,
                    name=name,
                    image_id=first + number,
                    intrinsics=lenses[image.intrinsics],
                    quat=quat_from_rotation(turn @ image.cam_from_world[:3, :3]),
                    translation=turn @ image.translation,
                    observations=Observations(xy[mine], seen.point_ids[mine]),
                )
            )
        moved.append((image.image_id, first + face, index))
    names = {image.name: cut.faces.get(image.name, [image.name]) for image in scene.images}
    kept = {name for each in names.values() for name in each}
    return replace(
        scene,
        images=tuple(image for image in made if image.name in kept),
        intrinsics=(),
        tracks=None if scene.tracks is None else _moved(scene.tracks, moved),
        depths=None,
        listed=split_of_faces(names, scene.listed),
        masks=cut.masks,
        # Lists, rigs and other files there are of the panoramas.
        source=SceneSource(image_dir=cut.folder, offset=scene.source.offset),
        absent=(),
    )


def _moved(tracks: Tracks, moved: Sequence[tuple[int, np.ndarray, np.ndarray]]) -> Tracks:
    """Return tracks with other images and features.

    ``moved`` has for each image its old id, and the new image and index of each feature. What is
    not there gets image 0, which no scene has: ``write_scene`` drops it.
    """
    ids, index = np.zeros(len(tracks.image_ids), np.uint32), tracks.point2d_idx.copy()
    order = np.argsort(tracks.image_ids, kind="stable")
    for image_id, new_ids, new_index in moved:
        first, last = np.searchsorted(tracks.image_ids, [image_id, image_id + 1], sorter=order)
        rows = order[first:last]
        rows = rows[index[rows] < len(new_ids)]
        ids[rows], index[rows] = new_ids[index[rows]], new_index[index[rows]]
    return replace(tracks, image_ids=ids, point2d_idx=index)


def split_of_faces(names: Mapping[str, Sequence[str]], listed: Split | None = None) -> Split | None:
    """Return the split of photographs that are cut, as ``Scene.split`` makes it, for a list.

    Trainers that do not recognise faces read the list. ``names`` are those of each photograph's
    faces. None without a list and with too few photographs.
    """
    if listed is None and len(names) < MIN_HELD_OUT:
        return None
    test = set(sorted(names)[::TEST_EVERY]) if listed is None else listed.test
    train = names.keys() - test if listed is None else listed.train
    trained, tested = (
        frozenset(face for name in part for face in names.get(name, ())) for part in (train, test)
    )
    return Split(trained, tested, "list by panorama")
