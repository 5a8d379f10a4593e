"""Reading a scene in any format.

Notation: a *model* is a folder with COLMAP's cameras, images and points3D, each as ``.bin`` or
``.txt``. Promise: one function recognises what a path holds and reads it; what is odd but usable
becomes a sentence in ``Scene.warnings``, anything else raises one error.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.cleaning import clean_scene, cloud_warnings
from splatseed.io.colmap.scene import find_model, read_colmap_scene, scene_root
from splatseed.io.files import is_video, odd_kind, read_text
from splatseed.io.nerfstudio import is_blender, read_blender, read_transforms_scene
from splatseed.io.ply import read_ply, refuse_model
from splatseed.io.rgbd import is_tum, load_rgbd, load_tum
from splatseed.io.seeds import recall_seeds
from splatseed.io.split import follow_lists
from splatseed.io.staging import MANIFEST, read_manifest
from splatseed.literal import quoted
from splatseed.scene import Scene, SceneSource

_TRANSFORMS = "transforms.json"
_ABOVE = 3
"""Folders above a file in which its scene is looked for: images may lie in folders of their own."""
_SCANS = frozenset({".las", ".laz", ".e57", ".pcd", ".xyz", ".asc", ".pts", ".glb"})
_TRIANGULATE = "Make points with: splatseed sfm IMAGES --poses-from SCENE -o OUT."


def load_scene(path: str | Path, *, require_points: bool = True) -> Scene:
    """Read a scene.

    Args:
        path: A folder with a COLMAP model (``sparse/0``, ``sparse``, ``colmap/sparse/0``, itself
            the model, or ``0`` in it), with ``transforms.json``, with ``transforms_train.json`` and
            ``transforms_test.json``, or with an RGB-D capture (``traj.txt``, or ``rgb.txt`` and
            ``groundtruth.txt``); or a ``.json`` or ``.ply`` file. Where there are several,
            ``sparse`` precedes ``transforms.json``, which precedes ``colmap/sparse/0``.
        require_points: Whether a scene without points is an error; else its cloud is empty.

    Returns:
        The scene in the world frame of its files, cameras in OpenCV axes. Points are finite and
        distinct: ``left_out`` counts the points of the files that are not, and ``warnings`` report
        them. Points that splatseed added before have no tracks; their ``source`` and attributes
        come from ``seeds.npz``, else ``source`` is 255 (``GENERATED``).

    Raises:
        SceneNotFoundError: There is no scene, or it has no points.
        SceneFormatError: A file is not what its format promises.
    """
    path = Path(path)
    try:
        scene = _read(path)
    except OSError as error:  # from looking for files; reading them raises our own
        raise SceneFormatError(
            f"a scene at {path} that can be read",
            found=f"{error.strerror or type(error).__name__} at {error.filename or path}",
            fix="Check that you may read the folder and its files.",
        ) from None
    if require_points and not len(scene.points):
        fix = _TRIANGULATE if scene.images else "Name a scene or a PLY that has points."
        raise SceneNotFoundError(f"points in {path}", found="none", fix=fix)
    # seeds.npz and the manifest count the points as the files have them, so this comes first.
    scene = clean_scene(follow_lists(recall_seeds(scene)))
    return scene.replace(warnings=(*scene.warnings, *cloud_warnings(scene.points)))


def load_originals(path: str | Path, *, require_points: bool = True) -> Scene:
    """Read a scene without the points that splatseed added to it before.

    Args:
        path: As for ``load_scene``.
        require_points: Whether a scene without originals is an error; else its cloud is empty.

    Returns:
        The scene with its originals alone, and a warning if it had other points.

    Raises:
        SceneNotFoundError: There is no scene, or it has no originals.
        SceneFormatError: A file is not what its format promises.
    """
    scene = load_scene(path, require_points=require_points)
    points = scene.points.originals
    added = len(scene.points) - len(points)
    if not added:
        return scene
    if require_points and not len(points):
        raise SceneNotFoundError(
            f"points in {path} that splatseed did not add",
            found=f"none: it made all {added:,}",
            fix=_TRIANGULATE if scene.images else "Name a scene or a PLY that has other points.",
        )
    which = f"Only the {len(points):,} originals are used" if len(points) else "None is an original"
    note = f"{which}: the {added:,} points that splatseed added before are replaced."
    return scene.replace(points=points, warnings=(*scene.warnings, note))


def check_there(path: Path) -> None:
    """Refuse the path of a scene at which there is neither a file nor a folder.

    Raises:
        SceneNotFoundError: There is none.
    """
    if not path.is_file() and not path.is_dir():
        found = odd_kind(path) or "no such file or folder"
        raise SceneNotFoundError(f"a scene at {path}", found=found, fix="Check the path.")


def is_scene(folder: Path) -> bool:
    """Whether a folder looks like a scene, by the names in it."""
    models = (folder / "sparse/0", folder / "sparse", folder, folder / "colmap/sparse/0")
    if find_model(*models) is not None or is_tum(folder) or is_blender(folder):
        return True
    return any((folder / name).is_file() for name in (_TRANSFORMS, "traj.txt"))


def _read(path: Path) -> Scene:
    if path.is_file():
        return _read_file(path)
    check_there(path)
    first = find_model(path / "sparse" / "0", path / "sparse", path, path / "0")
    if first is not None:
        return read_colmap_scene(first)
    if (path / _TRANSFORMS).is_file():
        return read_transforms_scene(path / _TRANSFORMS)
    if is_blender(path):
        return read_blender(path)
    nested = find_model(path / "colmap" / "sparse" / "0")
    if nested is not None:
        return read_colmap_scene(nested)
    if not (path / "traj.txt").is_file() and not is_tum(path):
        raise _no_scene(path)
    return load_rgbd(path) if (path / "traj.txt").is_file() else load_tum(path)


def _read_file(path: Path) -> Scene:
    refuse_model(path)
    kind, suffix = read_manifest(path.parent).get("command"), path.suffix.lower()
    if kind is not None and suffix == ".json" and not path.name.startswith("transforms"):
        if kind == "train":
            raise _is_run(path.parent)
        if is_scene(path.parent):
            raise SceneFormatError(
                f"{path} to be a scene folder, a .ply or a .json file with frames",
                found=f"notes on what splatseed {kind} wrote",
                fix=f"Name the scene's folder: {path.parent}",
            )
    if suffix == ".ply":
        return Scene(read_ply(path), source=SceneSource("ply", path.parent, path))
    if suffix == ".json":
        return read_transforms_scene(path)
    if is_video(path):
        found, fix = "a video", f"Make a scene of it first: splatseed sfm {quoted(path)} -o SCENE."
    elif find_model(path.parent) is not None:
        found = "one file of a COLMAP model"
        fix = f"Name the scene's folder: {scene_root(path.parent)}"
    elif suffix in _SCANS:
        found = f"a {suffix} file, a scan"
        fix = f"Make seeds of it: splatseed upsample SCENE --cloud {quoted(path)} -o OUT."
    else:
        found, folder = f"a {path.suffix or 'nameless'} file", _scene_above(path)
        fix = f"Name the scene's folder{f': {folder}' if folder else '.'}"
    expected = f"{path} to be a scene folder, a .ply or a .json file"
    raise SceneFormatError(expected, found=found, fix=fix)


def _scene_above(path: Path) -> Path | None:
    """The scene that a file or folder lies in, spelled as the path is."""
    for level, folder in enumerate(path.absolute().parents[:_ABOVE]):
        if is_scene(folder):
            return path.parents[level] if level < len(path.parents) else folder
    return None


def _no_scene(path: Path) -> SceneNotFoundError:
    if read_manifest(path).get("command") == "train":
        return _is_run(path)
    scenes = [each.name for each in sorted(path.iterdir()) if is_scene(each)]
    files = {each.name for suffix in ("*.json", "*.ply") for each in path.glob(suffix)}
    near, above = sorted(files - {MANIFEST}), _scene_above(path)
    inside = f"only {_some(near)}" if near else "none of them"
    fix = "Name the scene's folder, or a .ply or .json file itself."
    if scenes:
        inside, fix = f"scenes in it: {_some(scenes)}", f"Name one of them: {path / scenes[0]}"
    elif above is not None:
        fix = f"Name the scene's folder: {above}"
    else:
        fix += " For photographs alone, run: splatseed sfm IMAGES -o SCENE."
    return SceneNotFoundError(
        f"sparse/0, sparse, colmap/sparse/0, {_TRANSFORMS}, traj.txt or groundtruth.txt in {path}",
        found=inside,
        fix=fix,
    )


def _is_run(path: Path) -> SceneNotFoundError:
    try:
        scene = json.loads(read_text(path / "config.json"))["scene"]
    except (OSError, ValueError, TypeError, KeyError):
        scene = None
    run, named = quoted(path), isinstance(scene, str)
    return SceneNotFoundError(
        f"a scene at {path}",
        found="a run of splatseed train" + (f" on the scene {scene}" if named else ""),
        fix=f"Look at it: splatseed view {run}. Score it: splatseed evaluate {run}.",
    )


def _some(names: Sequence[str]) -> str:
    """The first five names, and how many more there are."""
    more = f" and {len(names) - 5:,} more" if len(names) > 5 else ""
    return ", ".join(names[:5]) + more
