"""Load a scene of any format, and find depth maps for its images.

A reader reports what it can work around as ``Scene.findings``, and raises an error for the rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from splatseed.depthmap import DepthKind
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError, SplatseedError
from splatseed.findings import Finding, without_kinds
from splatseed.io.bundler import find_bundler, read_bundler
from splatseed.io.cleaning import clean_scene, outlier_findings
from splatseed.io.colmap_model import find_model, nested_model, read_model, scene_model, scene_root
from splatseed.io.copies import without_copies
from splatseed.io.depth_files import KINDS, SUFFIXES
from splatseed.io.depth_maps import (
    DEPTH_KIND,
    DISTORTED_MAPS,
    WITHOUT_CONFIDENCE,
    DepthFiles,
    fitted_to_undistorted,
    map_findings,
    match_by_name,
)
from splatseed.io.files import StrPath, is_video, special_kind
from splatseed.io.llff import is_llff, read_llff
from splatseed.io.meshroom import find_meshroom, read_meshroom
from splatseed.io.metashape import find_metashape, read_metashape
from splatseed.io.nerfstudio import is_blender, read_blender, read_transforms_scene
from splatseed.io.openmvg import find_openmvg, read_openmvg
from splatseed.io.opensfm import find_opensfm, read_opensfm
from splatseed.io.origin import recentered
from splatseed.io.photogrammetry import largest
from splatseed.io.picture import find_white
from splatseed.io.ply import read_ply_float64, refuse_gaussians
from splatseed.io.polycam import is_polycam, read_polycam
from splatseed.io.pose_files import is_pose_folder, read_pose_folder
from splatseed.io.realityscan import find_realityscan, read_realityscan
from splatseed.io.record3d import (
    ARCHIVE,
    find_recorded_depths,
    is_record3d,
    is_rgbd_video,
    read_r3d,
    read_record3d,
)
from splatseed.io.rgbd import find_tum_depths, is_replica, is_tum, load_rgbd, load_tum
from splatseed.io.rtabmap import find_rtabmap, read_rtabmap
from splatseed.io.scanner_app import is_scanner_app, read_scanner_app
from splatseed.io.seeds import recall_seeds, restore_absent, with_recorded_masks
from splatseed.io.split import with_listed_split
from splatseed.io.staging import MANIFEST, read_manifest
from splatseed.io.stray import is_stray, read_stray
from splatseed.lens import undistort_command
from splatseed.scene import Scene, SceneSource
from splatseed.text import counted, name_some, quoted

_TRANSFORMS, _BLENDER = "transforms.json", "transforms_train.json"
_MAX_LEVELS_UP = 3
"""How many parent folders of a file are searched for its scene."""
_SCAN_SUFFIXES = frozenset({".las", ".laz", ".e57", ".pcd", ".xyz", ".asc", ".pts", ".glb"})


class Reader(NamedTuple):
    """A format of folders that hold neither a COLMAP model nor a transforms.json."""

    files: str  # by which it is recognised, for messages
    recognises: Callable[[Path], bool]
    read: Callable[[Path], Scene]


class ExportFormat(NamedTuple):
    """A format of one file of cameras, of which a folder may hold several."""

    files: str  # by which it is recognised, for messages
    find: Callable[[Path], list[Path]]  # in a folder
    read: Callable[[Path, Path], Scene]  # of a file and its scene's folder

    def files_in(self, folder: Path) -> list[Path]:
        """List such files; none where a folder or file may not be read."""
        with suppress(OSError):
            return self.find(folder)
        return []

    def recognises(self, folder: Path) -> bool:
        """Whether a folder has such a file."""
        return bool(self.files_in(folder))

    def read_folder(self, folder: Path) -> Scene:
        """Read the largest file of a folder."""
        path, findings = largest(self.find(folder))
        scene = self.read(path, folder)
        return scene.replace(findings=(*findings, *scene.findings))


EXPORTS = (
    ExportFormat("Metashape's .xml", find_metashape, read_metashape),
    ExportFormat("RealityScan's .csv", find_realityscan, read_realityscan),
    ExportFormat("OpenSfM's reconstruction.json", find_opensfm, read_opensfm),
    ExportFormat("Bundler's .out", find_bundler, read_bundler),
    ExportFormat("OpenMVG's sfm_data.json", find_openmvg, read_openmvg),
    ExportFormat("Meshroom's .sfm", find_meshroom, read_meshroom),
    ExportFormat("RTAB-Map's _camera_poses.txt", find_rtabmap, read_rtabmap),
)
READERS = (
    Reader("poses_bounds.npy", is_llff, read_llff),
    Reader("traj.txt", is_replica, load_rgbd),
    Reader("rgb.txt with groundtruth.txt", is_tum, load_tum),
    Reader("3D Scanner App's frame_00000.json", is_scanner_app, read_scanner_app),
    Reader("Polycam's keyframes", is_polycam, read_polycam),
    Reader("Record3D's EXR_RGBD", is_record3d, read_record3d),
    Reader("Stray Scanner's rgb.mp4 with odometry.csv", is_stray, read_stray),
    *(Reader(each.files, each.recognises, each.read_folder) for each in EXPORTS),
    Reader(
        "ScanNet's pose with color, 7-Scenes' frame-000000.pose.txt",
        is_pose_folder,
        read_pose_folder,
    ),
)
"""Tried in this order, after COLMAP models and transforms.json."""
_INCOMPLETE = (
    ("rgb.txt", "groundtruth.txt", "the poses, each line: time, tx ty tz, qx qy qz qw"),
    ("groundtruth.txt", "rgb.txt", "the photographs, each line: time, path"),
    ("transforms_test.json", _BLENDER, "the frames to train on"),
    ("transforms_val.json", _BLENDER, "the frames to train on"),
    ("cam_params.json", "traj.txt", "the poses, each line: 16 numbers of world_from_cam"),
    ("odometry.csv", "rgb.mp4", "the photographs of Stray Scanner's recording"),
    ("camera_matrix.csv", "odometry.csv", "the poses of Stray Scanner's recording"),
    ("database.db", "sparse/0", "the model that COLMAP's mapper makes of its database"),
)
"""Files that a folder has, the file that it then needs, and its content."""
_TRAJECTORIES = ("CameraTrajectory.txt", "KeyFrameTrajectory.txt")
"""ORB-SLAM's files of poses, of the form of ``groundtruth.txt``."""
_TRIANGULATE = (
    "Method auto needs none: splatseed upsample SCENE -o OUT. Or make points with: splatseed sfm"
    " IMAGES --poses-from SCENE -o OUT."
)


def load_scene(path: StrPath, *, require_points: bool = True, panoramas: bool = False) -> Scene:
    """Load a scene.

    Args:
        path: A folder with a COLMAP model (in ``sparse/0``, ``sparse``, ``colmap/sparse/0``, the
            folder itself or its subfolder ``0``), ``transforms.json``, ``transforms_train.json``
            and ``transforms_test.json``, LLFF's ``poses_bounds.npy``, an RGB-D capture
            (``traj.txt``, or ``rgb.txt`` and ``groundtruth.txt``, or a file per pose), the export
            of a phone app (3D Scanner App's ``frame_00000.json``, Polycam's ``keyframes``,
            Record3D's ``EXR_RGBD``, Stray Scanner's ``rgb.mp4`` and ``odometry.csv``), or a file of
            cameras of Metashape, RealityScan, OpenSfM, Bundler, OpenMVG, Meshroom or RTAB-Map; or
            that file, or a ``.json``, ``.ply`` or ``.r3d`` file (Record3D's).
            ``sparse`` takes precedence over ``transforms.json`` (except in an output of splatseed
            that has both), and that over ``colmap/sparse/0``.
        require_points: Raise for a scene without points; if False, its cloud is empty.
        panoramas: Accept equirectangular cameras, which only ``sfm.undistort`` can use: their
            ``K`` is NaN.

    Returns:
        The scene, with cameras in OpenCV axes. Coordinates are those of its files, minus
        ``origin`` if they are far from 0. Points are finite and distinct; ``left_out`` counts the
        others. Points that splatseed added earlier have no tracks; ``source`` and attributes come
        from ``seeds.npz``, else their ``source`` is 255 (``GENERATED``).

    Raises:
        SceneNotFoundError: No scene there, or it has no points.
        SceneFormatError: A file is malformed, or a photograph a panorama.
    """
    path = Path(path)
    try:
        check_exists(path)
        reader = partial(_read_file, path) if path.is_file() else _reader(path)
        if reader is None:
            raise _no_scene_error(path)
        scene = reader()
        scene = scene.replace(source=replace(scene.source, named=path.absolute()))
        if isinstance(scene.depths, DepthFiles):  # their format states the unit
            scene = scene.replace(depths=replace(scene.depths, in_scene_units=True))
    except SplatseedError:
        raise
    except OSError as error:  # from listing folders; reading files raises SplatseedError
        raise SceneFormatError(
            f"a readable scene at {path}",
            found=f"{error.strerror or type(error).__name__} at {error.filename or path}",
            fix="Check that you may read the folder and its files.",
        ) from None
    whole = [image.name for image in scene.images if image.intrinsics.is_panorama]
    if whole and not panoramas:
        raise SceneFormatError(
            f"perspective or fisheye photographs in {path}",
            found=f"{counted(len(whole), 'equirectangular panorama')} ({name_some(whole, 3)})",
            fix=f"Cut them into perspective photographs first: {undistort_command(path)}.",
        )
    if require_points and not len(scene.points):
        fix = _TRIANGULATE if scene.images else "Choose a scene or a PLY with points."
        raise SceneNotFoundError(f"points in {path}", found="none", fix=fix)
    # seeds.npz and the manifest refer to the points as stored: restore before cleaning.
    scene = without_copies(with_listed_split(restore_absent(recall_seeds(scene))))
    scene = clean_scene(scene)
    scene = with_recorded_masks(scene)
    white, found = find_white([image.path for image in scene.images if image.folder])
    found += map_findings(scene.depths)
    findings = (*scene.findings, *found, *outlier_findings(scene.points))
    return scene.replace(findings=findings, white=white)


def load_originals(path: StrPath, *, require_points: bool = True) -> Scene:
    """Load a scene without the points that splatseed added earlier, and warn if there were any.

    Raises as ``load_scene``, and ``SceneNotFoundError`` if no original points remain.
    """
    path = Path(path)
    scene = load_scene(path, require_points=require_points)
    points = scene.points.originals
    added = len(scene.points) - len(points)
    if not added:
        return scene
    if require_points and not len(points):
        raise SceneNotFoundError(
            f"points in {path} that splatseed did not add",
            found=f"none: it made all {added:,}",
            fix=_TRIANGULATE if scene.images else "Choose a scene or a PLY with other points.",
        )
    used = f"Only the {len(points):,} original points are used" if len(points) else "No originals"
    text = f"{used}: the {added:,} points that splatseed added before are dropped."
    findings = (*scene.findings, Finding("added-points-dropped", text))
    return scene.replace(points=points, findings=findings)


def check_exists(path: Path) -> None:
    """Raise ``SceneNotFoundError`` unless the path is a file or a folder."""
    if not path.is_file() and not path.is_dir():
        found = special_kind(path) or "no such file or folder"
        raise SceneNotFoundError(f"a scene at {path}", found=found, fix="Check the path.")


def is_scene(folder: StrPath) -> bool:
    """Whether a folder contains the files of a scene; their content is not read."""
    return _reader(Path(folder)) is not None


def _reader(folder: Path) -> Callable[[], Scene] | None:
    if read_manifest(folder).get("format") == "both" and (folder / _TRANSFORMS).is_file():
        return partial(read_transforms_scene, folder / _TRANSFORMS)  # it says more: masks, depth
    if (model := scene_model(folder)) is not None:
        return partial(read_model, model, folder)
    if (folder / _TRANSFORMS).is_file():
        return partial(read_transforms_scene, folder / _TRANSFORMS)
    if is_blender(folder):
        return partial(read_blender, folder)
    if (nested := nested_model(folder)) is not None:
        return partial(read_model, nested, folder)
    found = (partial(each.read, folder) for each in READERS if each.recognises(folder))
    return next(found, None)


def _read_file(path: Path) -> Scene:
    refuse_gaussians(path)
    kind, suffix = read_manifest(path.parent).get("command"), path.suffix.lower()
    if kind is not None and suffix == ".json" and not path.name.startswith("transforms"):
        if kind == "train":
            raise _run_error(path.parent)
        if is_scene(path.parent):
            raise SceneFormatError(
                f"{path} to be a scene folder, a .ply or a .json file with frames",
                found=f"the manifest of an output of splatseed {kind}",
                fix=f"Pass the scene's folder: {path.parent}",
            )
    if suffix == ".ply":
        points, exact = read_ply_float64(path)
        source = SceneSource("ply", path.parent, path)
        return recentered(Scene(points, source=source), exact)
    for each in EXPORTS:
        if suffix != ".ply" and path in each.files_in(path.parent):
            return each.read(path, path.parent)
    if suffix == ".json":
        return read_transforms_scene(path)
    if _is_archive(path):
        return read_r3d(path)
    expected = f"{path} to be a scene folder, a .ply, .json or {ARCHIVE} file"
    found, fix = _video_advice(path) if is_video(path) else _file_advice(path)
    raise SceneFormatError(expected, found=found, fix=fix)


def _video_advice(path: Path) -> tuple[str, str]:
    """Return what a video is that is no scene, and what to do."""
    if is_rgbd_video(path):
        fix = 'In the app, export the recording as "EXR + RGB" or as .r3d, which have them.'
        return 'Record3D\'s export "RGBD video", which has no poses', fix
    if is_stray(path.parent):
        return "the video of Stray Scanner", f"Pass the scene's folder: {path.parent}"
    return "a video", f"Reconstruct a scene first: splatseed sfm {quoted(path)} -o SCENE."


def _file_advice(path: Path) -> tuple[str, str]:
    """Return what a file is that is neither a scene nor a video, and what to do."""
    suffix = path.suffix.lower()
    if find_model(path.parent) is not None:
        return "one file of a COLMAP model", f"Pass the scene's folder: {scene_root(path.parent)}"
    if suffix in _SCAN_SUFFIXES:
        fix = f"Use it as seeds: splatseed upsample SCENE --cloud {quoted(path)} -o OUT."
        return f"a {suffix} file, a scan", fix
    if suffix == ".zip":
        return "an archive", "Unpack it, and pass the scene's folder."
    folder = _scene_above(path)
    fix = f"Pass the scene's folder{f': {folder}' if folder else '.'}"
    return f"a {path.suffix or 'nameless'} file", fix


def _scene_above(path: Path) -> Path | None:
    """Find the scene folder that contains a path; relative if the path is."""
    for level, folder in enumerate(path.absolute().parents[:_MAX_LEVELS_UP]):
        if is_scene(folder):
            return path.parents[level] if level < len(path.parents) else folder
    return None


def _no_scene_error(path: Path) -> SceneNotFoundError:
    if read_manifest(path).get("command") == "train":
        return _run_error(path)
    scenes = [child.name for child in sorted(path.iterdir()) if is_scene(child)]
    incomplete = None if scenes else _incomplete_error(path)
    if incomplete is not None:
        return incomplete
    files = {file.name for pattern in ("*.json", "*.ply") for file in path.glob(pattern)}
    names = scenes or sorted(files - {MANIFEST})
    listed = name_some(names, 5)
    found = f"scenes in it: {listed}" if scenes else f"only {listed}" if names else "none of them"
    if scenes:
        fix = f"Choose one: {path / scenes[0]}"
    elif (above := _scene_above(path)) is not None:
        fix = f"Pass the scene's folder: {above}"
    else:
        fix = "Pass the scene's folder, or a .ply or .json file. To reconstruct photographs, "
        fix += "run: splatseed sfm IMAGES -o SCENE."
    *first, last = (each.files for each in READERS)
    expected = ", ".join(["sparse/0, sparse, colmap/sparse/0", _TRANSFORMS, *first])
    return SceneNotFoundError(f"{expected} or {last} in {path}", found=found, fix=fix)


def _incomplete_error(path: Path) -> SceneNotFoundError | None:
    """Return the error for a folder that lacks one file of a format; None for others."""
    for there, lacking, content in _INCOMPLETE:
        if (path / there).is_file() and not (path / lacking).exists():
            fix = f"Copy it there: it has {content}."
            tracks = [name for name in _TRAJECTORIES if (path / name).is_file()]
            if lacking == "groundtruth.txt" and tracks:
                fix = f"Rename {tracks[0]}, if its lines are: time, tx ty tz, qx qy qz qw."
            elif "poses" in content or there == "database.db":
                fix += " Or estimate poses: splatseed sfm IMAGES -o SCENE."
            return SceneNotFoundError(f"{lacking} beside {path / there}", found="none", fix=fix)
    return None


def _run_error(path: Path) -> SceneNotFoundError:
    run = quoted(path)
    return SceneNotFoundError(
        f"a scene at {path}",
        found="a run of splatseed train",
        fix=f"View it with splatseed view {run}, score it with splatseed evaluate {run}.",
    )


def find_depths(
    scene: Scene, path: StrPath, *, kind: DepthKind | None = None, scale: float | None = None
) -> DepthFiles:
    """Find depth maps for a scene's images; each map is read on demand.

    Args:
        scene: The scene.
        path: A folder of maps named like the images, subfolders included; a COLMAP dense workspace;
            an RGB-D capture in NICE-SLAM's or TUM's layout; a recording of Record3D; or the output
            of ``splatseed depth``.
        kind: Meaning of the values; None: as the folder declares, else planar z.
        scale: Stored units per scene unit; None: as the folder declares, else 1000 for integers
            and 1 for floats.

    Raises:
        ParameterError: Unknown kind, or a scale that is not positive.
        SceneNotFoundError: No such folder, or no image has a map in it.
        SceneFormatError: Two images share a map, or the folder's description is malformed.
    """
    if kind is not None and kind not in KINDS:
        expected = f"`kind` to be one of {', '.join(KINDS)}"
        raise ParameterError(expected, found=repr(kind), fix="Choose one of them.")
    if scale is not None and not 0 < scale < math.inf:
        fix = "Pass the stored units per scene unit."
        raise ParameterError("`scale` above 0", found=f"{scale}", fix=fix)
    root = Path(path)
    if not root.is_dir() and not _is_archive(root):
        found, fix = (
            "a file" if root.exists() else "nothing",
            "Pass the folder that contains the maps.",
        )
        raise SceneNotFoundError(f"a folder of depth maps at {root}", found=found, fix=fix)
    maps = search_depths(scene, root)
    if maps is None:
        name = scene.images[0].name if scene.images else ""
        such_as = f", such as {name}{SUFFIXES[0]} or {Path(name).stem}.png" if name else ""
        raise SceneNotFoundError(
            f"depth maps of the scene's images in {root}{such_as}",
            found="none" if name else "a scene without images",
            fix="Give maps the names of their images, subfolders included, with another suffix.",
        )
    lines = {} if scale else maps.lines  # an explicit scale is that of plain values
    maps = replace(maps, kind=kind or maps.kind, scale=scale or maps.scale, lines=lines)
    maps = fitted_to_undistorted(scene, maps)
    own = scene.depths
    if isinstance(own, DepthFiles) and _same_maps(own, maps):
        return replace(maps, in_scene_units=own.in_scene_units)  # the capture's, named again
    return maps


def with_depths_in(
    scene: Scene, path: StrPath, *, kind: DepthKind | None = None, scale: float | None = None
) -> Scene:
    """Attach the depth maps of a folder instead of the scene's own; arguments of ``find_depths``.

    Raises as ``find_depths``.
    """
    return _with_maps(scene, find_depths(scene, path, kind=kind, scale=scale))


def _with_maps(scene: Scene, maps: DepthFiles | None) -> Scene:
    """Attach maps, with findings about them in place of those about the scene's own."""
    kept = without_kinds(scene.findings, DEPTH_KIND, DISTORTED_MAPS, WITHOUT_CONFIDENCE)
    return scene.replace(depths=maps, findings=(*kept, *map_findings(maps)))


def _same_maps(maps: DepthFiles, others: DepthFiles) -> bool:
    if maps.scale != others.scale or maps.paths.keys() != others.paths.keys():
        return False
    return all(path.samefile(others.paths[name]) for name, path in maps.paths.items())


def _is_archive(path: Path) -> bool:
    return path.suffix.lower() == ARCHIVE and path.is_file()


def with_own_depths(scene: Scene) -> Scene:
    """Attach the depth maps found in the scene's own folder, unless it has maps already."""
    root = scene.source.root
    if scene.depths is not None or root is None:
        return scene
    return _with_maps(scene, search_depths(scene, root))


def depths_beside(scene: Scene) -> DepthFiles | None:
    """Find files named as depth maps in the folder of a scene without maps; None without any.

    In contrast to ``with_own_depths``, nobody asked for them: other files count less readily.
    """
    root = scene.source.root
    if scene.depths is not None or root is None:
        return None
    try:
        maps = search_depths(scene, root)
    except SplatseedError:
        return None  # method depth, which needs them, raises it
    shown = (
        [] if maps is None else [f"{path.parent.name}/{path.name}" for path in maps.paths.values()]
    )
    return maps if shown and all("depth" in each.lower() for each in shown) else None


def search_depths(scene: Scene, root: Path) -> DepthFiles | None:
    """Find depth maps as ``find_depths`` does; None if no image has one."""
    if _is_archive(root) or is_record3d(root):
        return find_recorded_depths(scene, root)
    if is_tum(root) and (maps := find_tum_depths(scene, root)) is not None:
        return maps
    if (maps := match_by_name(scene, root)) is not None:
        return maps
    capture = root.resolve().parent  # the path may be the capture's folder of depth images
    return find_tum_depths(scene, capture) if is_tum(capture) else None
