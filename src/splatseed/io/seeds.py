"""What an output records of its scene that the layout's files do not: ``seeds.npz`` and manifest.

``seeds.npz`` has the origin and attributes of points, which point files have no field for. It
holds, in the order of the points, ``source`` uint8 [N] if any point was added, ``normals`` float16
[N, 3], ``sizes`` float32 [N] and ``confidence`` float16 [N] where known for any point, and a
``digest`` of the positions. ``source`` is the only record of a point's origin: without it all
points are originals; counts in ``splatseed.json`` are for people. A file that is damaged or belongs
to other points is ignored with a warning. The manifest records absent images and masks, without
which the scene would be read with other test views, or with masks that it does not use.
"""

from __future__ import annotations

import math
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from splatseed.errors import PointCloudError
from splatseed.findings import Finding
from splatseed.io.files import ARCHIVE_FAILURES, read_npy
from splatseed.io.masks import ALPHA, with_own_masks
from splatseed.io.staging import MANIFEST, read_manifest, write_json
from splatseed.pointcloud import ATTRIBUTES, ORIGINAL, PointCloud
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scene import Masks, Scene

SEEDS = "seeds.npz"
UPSAMPLED = "upsampled"
"""Where the manifest of an undistorted scene holds that of the points."""

_STORED: dict[str, tuple[tuple[int, ...], np.dtype[Any]]] = {
    "source": ((), np.dtype("u1")),
    # Half precision rotates a normal by 0.03 degrees at most; sizes have no bounded range.
    **{
        name: (shape, np.dtype("<f4" if name == "sizes" else "<f2"))
        for name, shape in ATTRIBUTES.items()
    },
}
"""Shape of one point's value, and type in the file."""
_DIGEST_BYTES = 16
_IGNORED = "seeds-file-ignored"  # the kind of finding
_ABSENT = "absent"
"""The manifest's key for ``Scene.absent``."""
_TRANSPARENT, _BLACK, _LEFT_OUT = "transparent", "black", "masked"
"""The manifest's entries for masks without ``Masks.alpha``, and with it by the user's choice."""
_MASKED, _NOTHING = "masks", "none"
"""The manifest's entry for a scene without masks, whatever lies near its photographs."""


def _position_digest(xyz: Float32[np.ndarray, "n 3"]) -> bytes:
    """The fingerprint of positions; -0.0 counts as 0.0."""
    positions = np.ascontiguousarray(xyz + np.float32(0.0), "<f4").tobytes()
    return bytes.fromhex(fingerprint(positions))


def write_seeds(folder: Path, points: PointCloud) -> None:
    """Write ``seeds.npz`` into an output, if any point was added or has attributes."""
    known = {n: values for n, values in points.attributes.items() if not np.isnan(values).all()}
    if (points.source != ORIGINAL).any():
        known = {"source": points.source, **known}
    if known:
        arrays = {name: values.astype(_STORED[name][1]) for name, values in known.items()}
        arrays = {"digest": np.frombuffer(_position_digest(points.xyz), np.uint8), **arrays}
        np.savez_compressed(folder / SEEDS, **arrays)  # type: ignore[arg-type]  # by name


def recall_seeds(scene: Scene) -> Scene:
    """Give a scene's points the origin and the attributes in its ``seeds.npz``, if they match."""
    root = scene.source.root
    if root is None or not len(scene.points):
        return scene
    arrays, findings = _read_seeds(root, scene.points)
    points = scene.points.replace(**arrays)
    # Tracks belong to the first points, and a new point has none.
    first_new = int(np.append(points.source != ORIGINAL, True).argmax())
    tracks = scene.tracks
    if tracks is not None:
        tracks = tracks.select(np.arange(len(tracks)) < first_new)
    return replace(scene, points=points, tracks=tracks, findings=(*scene.findings, *findings))


def _upsampling(scene: Scene) -> dict[str, Any] | None:
    """What ``splatseed upsample`` wrote about the points, if it made them."""
    facts = read_manifest(scene.source.root)
    carried = facts if facts.get("command") == "upsample" else facts.get(UPSAMPLED)
    return carried if isinstance(carried, dict) else None


def was_upsampled(scene: Scene) -> bool:
    """Whether ``splatseed upsample`` made or thinned these points."""
    return _upsampling(scene) is not None or scene.points.num_original < len(scene.points)


def method_of_points(scene: Scene) -> str:
    """Return the name of the method that made the scene's new points; "other" if unknown."""
    method = (_upsampling(scene) or {}).get("method")
    return method if isinstance(method, str) else "other"


def saw_all_photographs(scene: Scene) -> bool:
    """Whether ``splatseed upsample`` made new points from photographs and held none out."""
    facts = _upsampling(scene) or {}
    try:
        parameters = facts["parameters"]  # early outputs of splatseed 0.3 have hold_out
        test_every = parameters.get("test_every", parameters.get("hold_out"))
        all_used = test_every == 0 and not facts.get("listed_tests_held_out")
        return bool(facts["num_new"]) and all_used
    except (TypeError, KeyError, AttributeError):
        return False  # not made from photographs


def carry_seeds(scene: Scene, written: Path, folder: Path) -> None:
    """Let an undistorted scene remember where its points come from, and what is known of them.

    ``written`` is what ``write_scene`` made of ``scene``; ``folder`` will be the undistorted scene,
    with the same points in the same order.
    """
    if (written / SEEDS).is_file():
        shutil.copyfile(written / SEEDS, folder / SEEDS)
    write_json(folder / MANIFEST, {**facts_for_reading(scene), UPSAMPLED: _upsampling(scene)})


def _read_seeds(
    folder: Path, points: PointCloud
) -> tuple[dict[str, np.ndarray], tuple[Finding, ...]]:
    path = folder / SEEDS
    try:
        if not path.is_file():
            return {}, ()
        with zipfile.ZipFile(path) as archive:
            digest = _member(archive, "digest", (_DIGEST_BYTES,), np.dtype("u1"))
            if digest.tobytes() != _position_digest(points.xyz):
                found = "it belongs to other points than the scene's, which all count as originals"
                return {}, (Finding(_IGNORED, f"{SEEDS} was ignored: {found}."),)
            there = {name.removesuffix(".npy") for name in archive.namelist()}
            arrays = {
                name: _member(archive, name, (len(points), *shape), dtype)
                for name, (shape, dtype) in _STORED.items()
                if name in there
            }
        known = {n: a if n == "source" else a.astype(np.float32) for n, a in arrays.items()}
        points.replace(**known)  # checks the values
    except (*ARCHIVE_FAILURES, PointCloudError) as error:
        text = f"{SEEDS} was ignored: it is damaged, or not splatseed's ({type(error).__name__})."
        return {}, (Finding(_IGNORED, text),)
    return known, ()


def _member(
    archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]
) -> np.ndarray:
    """An array that must have just this shape and type, else a ``ValueError`` or ``KeyError``."""
    with archive.open(f"{name}.npy") as file:
        array = read_npy(file, math.prod(shape) * dtype.itemsize)
    if (array.shape, array.dtype) != (shape, dtype):
        raise ValueError(name)
    return array


# Entries of the manifest --------------------------------------------------------------------------


def facts_for_reading(scene: Scene) -> dict[str, Any]:
    """Return entries of an output's manifest by which ``load_scene`` reads it as this scene."""
    facts: dict[str, Any] = {}
    if scene.absent:  # so that the others train or test as before
        facts[_ABSENT] = list(scene.absent)
    if scene.masks is None and scene.source.image_dir:
        facts[_MASKED] = _NOTHING  # else masks near the photographs would count again
    if scene.masks and not scene.masks.alpha:  # else transparent pixels might be masked
        facts[_TRANSPARENT] = _BLACK
    if scene.masks and scene.masks.choice == ALPHA:  # else they might be empty
        facts[_TRANSPARENT] = _LEFT_OUT
    return facts


def restore_absent(scene: Scene) -> Scene:
    """Add the absent images that the manifest of a scene lists."""
    noted = read_manifest(scene.source.root).get(_ABSENT)
    if not isinstance(noted, list) or not all(isinstance(name, str) for name in noted):
        return scene
    known = {*scene.absent, *(image.name for image in scene.images)}
    return scene.replace(absent=(*scene.absent, *(name for name in noted if name not in known)))


def with_recorded_masks(scene: Scene) -> Scene:
    """Attach the masks near the photographs, as far as the manifest of a scene lets them count."""
    manifest = read_manifest(scene.source.root)
    if manifest.get(_MASKED) == _NOTHING:
        return scene.replace(masks=None)
    masks = scene.masks or Masks({})
    if manifest.get(_TRANSPARENT) == _BLACK:
        scene = scene.replace(masks=replace(masks, alpha=False))
    elif manifest.get(_TRANSPARENT) == _LEFT_OUT:
        scene = scene.replace(masks=replace(masks, alpha=True, choice=ALPHA))
    return with_own_masks(scene)
