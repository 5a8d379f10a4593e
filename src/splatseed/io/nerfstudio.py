"""Scenes in ``transforms.json`` (nerfstudio, instant-ngp, Blender data sets).

A *frame* is one posed image; its ``transform_matrix`` is ``world_from_cam`` in OpenGL axes (x
right, y up, z back). The *transforms' space* is the world frame of these poses;
``applied_transform`` [3, 4] maps the world of the Structure-from-Motion model to it. Source:
nerfstudio's "data conventions" page and instant-ngp's ``colmap2nerf`` output.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Intrinsics
from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io.camera_records import (
    MAX_ID,
    OPENCV_FROM_OPENGL,
    Lens,
    NotFiniteError,
    brown,
    check_enough,
    fisheye,
    make_intrinsics,
    panorama,
    rigid_pose,
    unusable_findings,
)
from splatseed.io.colmap_model import models_in, read_model_cameras, read_model_points
from splatseed.io.files import (
    StrPath,
    absolute,
    open_file,
    read_json,
    special_kind,
    translate_errors,
)
from splatseed.io.frame_files import (
    FIX,
    Frame,
    FrameFiles,
    any_photograph,
    find_frames,
    named_depths,
    named_masks,
)
from splatseed.io.origin import recentered
from splatseed.io.photograph import lens_findings
from splatseed.io.photograph_checks import ASPECT_SLACK, photograph_findings
from splatseed.io.picture import open_picture
from splatseed.io.ply import read_ply_float64
from splatseed.io.point_files import differing_points
from splatseed.pointcloud import PointCloud
from splatseed.scene import OPENGL, Image, Masks, Scene, SceneSource, Split
from splatseed.similarity import fit_similarity
from splatseed.text import agreeing, counted

_PERSPECTIVE = {"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"}
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_FISHEYE = "OPENCV_FISHEYE"
_PANORAMAS = ("EQUIRECTANGULAR", "SPHERICAL")
"""Names of lens models of full panoramas; nerfstudio and LichtFeld Studio know the first."""
UNDISTORTED = ("PINHOLE", "SIMPLE_PINHOLE")
LENS_MODELS = frozenset({"camera_model", "is_fisheye"})
"""Keys of which either states the lens model."""
_MAX_PIXELS = 1e9
"""Above all sizes and focal lengths, in pixels."""
_FOCAL_LENGTHS = {a: frozenset({f"{a}_fov", f"fl_{a}", f"camera_angle_{a}"}) for a in "xy"}
"""Keys of which any states a focal length."""
_ANY_FOCAL_LENGTH = _FOCAL_LENGTHS["x"] | _FOCAL_LENGTHS["y"]
_CONVENTION = f"each transform_matrix is world_from_cam, {OPENGL}"
_BLENDER = ("transforms_train.json", "transforms_test.json")
_POINT_FILES = ("sparse_pc.ply", "points3d.ply", "points3D.ply", "pointcloud.ply")
_LEGACY_TRANSFORM = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])
"""The transform of nerfstudio versions that do not write ``applied_transform``."""
_MIN_FITTED = 4
"""Fewest cameras to fit a similarity: it fits any three centres nearly exactly."""
Center = Float64[np.ndarray, " 3"]
Named = Sequence[tuple[str, Center]]
"""Names of images, and the centres of their cameras."""
_POSE_TOLERANCE = 1e-2  # of the cameras' extent, between transforms.json and its COLMAP model


@dataclass(frozen=True, eq=False)
class Transforms:
    """A parsed ``transforms.json``: images in the file's order, in OpenCV axes.

    Images and frames omit those whose pose or camera is not finite.
    """

    path: Path
    json: Mapping[str, Any]
    images: tuple[Image, ...]
    frames: tuple[Frame, ...]  # of the images
    intrinsics: tuple[Intrinsics, ...]
    image_dir: Path  # names are relative to it
    applied_transform: Float64[np.ndarray, "3 4"] | None
    findings: tuple[Finding, ...]
    absent: tuple[str, ...] = ()  # images of omitted frames

    @property
    def listed(self) -> Split | None:
        """The split of ``frames`` and ``test_frames``."""
        pairs = list(zip(self.images, self.frames, strict=True))
        test = frozenset(image.name for image, frame in pairs if frame.is_test)
        train = frozenset(image.name for image, frame in pairs if not frame.is_test)
        return Split(train, test, f"test_frames in {self.path.name}") if train and test else None


def read_transforms_scene(path: StrPath) -> Scene:
    """Read a ``transforms.json`` with its points, masks and depth maps; the cloud may be empty."""
    path = Path(path)
    transforms = read_transforms(path)
    points, exact, points_path, found = _find_points(transforms)
    images, folder = transforms.images, transforms.image_dir
    source = SceneSource(
        "transforms", path.parent, points_path, image_dir=folder, transforms_path=path,
        convention=_CONVENTION,
    )  # fmt: skip
    frames = {i.name: f.fields for i, f in zip(images, transforms.frames, strict=True)}
    masks, gone = named_masks(FrameFiles(path), frames)
    depths, lost = named_depths(FrameFiles(path), frames, transforms.json)
    found = [*transforms.findings, *found, *gone, *lost]
    found += photograph_findings(images, folder, path.parent)
    scene = Scene(
        points, images, transforms.intrinsics, source=source,
        findings=(*found, *lens_findings(images)),
        depths=depths,
        listed=transforms.listed,
        masks=Masks(masks) if masks else None, absent=transforms.absent,
    )  # fmt: skip
    return recentered(scene, exact)


def is_blender(folder: Path) -> bool:
    """Whether a folder has ``transforms_train.json``, the layout of Blender data sets."""
    return (folder / _BLENDER[0]).is_file()


def read_blender(folder: StrPath) -> Scene:
    """Read training and test images as one scene with their split, and points in their space.

    Image names include their folders (``train/r_0.png``). ``transforms_val.json`` is ignored, and
    so is a ``transforms_test.json`` without photographs, as BlenderNeRF writes it.
    """
    folder = Path(folder)
    parts, findings, split = [read_transforms(folder / _BLENDER[0])], list[Finding](), True
    if (path := folder / _BLENDER[1]).is_file() and any_photograph(path):
        parts.append(read_transforms(path))
    else:
        split, lacking = False, "there is none" if not path.is_file() else "it has no photographs"
        text = f"{path}: {lacking}, so some training images become test views."
        findings = [Finding("missing-test-views", text)]
    cameras: dict[tuple[object, ...], Intrinsics] = {}
    images: list[Image] = []
    masks: dict[str, Path] = {}
    for part in parts:
        fields: dict[str, Mapping[str, Any]] = {}
        for image, frame in zip(part.images, part.frames, strict=True):
            lens = image.intrinsics
            key = (lens.model, lens.width, lens.height, lens.params)
            shared = cameras.setdefault(key, replace(lens, camera_id=len(cameras) + 1))
            name = os.path.relpath(part.image_dir / image.name, folder.absolute())
            name = PurePath(name).as_posix()
            fields[name] = frame.fields
            images.append(replace(image, name=name, image_id=len(images) + 1, intrinsics=shared))
        found_masks, gone = named_masks(FrameFiles(part.path), fields)
        masks |= found_masks
        findings += gone
    points, exact, points_path, found = _find_points(parts[0])
    findings += [each for part in parts for each in part.findings] + found
    names, num_train = [image.name for image in images], len(parts[0].images)
    train, test = frozenset(names[:num_train]), frozenset(names[num_train:])
    scene = Scene(
        points,
        tuple(images),
        tuple(cameras.values()),
        source=SceneSource(
            "transforms", folder, points_path, image_dir=folder, convention=_CONVENTION
        ),
        findings=(
            *dict.fromkeys(findings),  # both files may have the same
            *photograph_findings(images, folder, folder),
            *lens_findings(images),
        ),
        listed=Split(train, test, f"pair of {_BLENDER[0]} and {_BLENDER[1]}") if split else None,
        masks=Masks(masks, alpha=False),  # transparent pixels are empty space, trained as black
    )
    return recentered(scene, exact)


def read_transforms(path: Path) -> Transforms:
    """Read the cameras and frames of a ``transforms.json``, without points."""
    meta = read_json(path, fix=FIX)
    frames, findings = find_frames(path, meta)
    # The subfolder that contains all images, else the deepest common folder. Links are not
    # followed, so that names are as in COLMAP.
    image_dir = Path(os.path.commonpath([frame.file.parent for frame in frames]))
    root = absolute(path).parent
    if root in image_dir.parents:
        image_dir = root / image_dir.relative_to(root).parts[0]
    named = [frame.fields.get("colmap_im_id") for frame in frames]
    ids = [i for i in named if isinstance(i, int) and 0 < i <= MAX_ID]
    if len({*ids}) < len(frames):
        ids = list(range(1, len(frames) + 1))
    cameras: dict[tuple[str, int, int, tuple[float, ...]], Intrinsics] = {}
    images: dict[str, Image] = {}
    kept: list[Frame] = []
    unusable: dict[str, NotFiniteError] = {}
    odd = repeated = 0
    for frame, image_id in zip(frames, ids, strict=True):
        name = frame.file.relative_to(image_dir).as_posix()
        where = f"{frame.where} ({name})"
        values = _merged(meta, frame.fields)
        try:
            key = _camera(where, values, frame.file)
            if key not in cameras:
                cameras[key] = make_intrinsics(where, len(cameras) + 1, *key)
            pose = _matrix(f"{where}, transform_matrix", frame.fields.get("transform_matrix"))
        except NotFiniteError as error:
            unusable[name] = error
            continue
        odd += bool(values.get("k4")) and key[0] != _FISHEYE
        quat, translation = rigid_pose(where, pose @ OPENCV_FROM_OPENGL)
        image = Image(name, image_id, cameras[key], quat, translation)
        if name in images:
            repeated += 1
            _check_repeated(where, images[name], image)
            continue
        images[name] = image
        kept.append(frame)
    check_enough(unusable, len(images))
    applied = meta.get("applied_transform")
    if applied is not None:
        applied = _matrix(f"{path}, applied_transform", applied)
    if odd:
        text = f"k4 of {odd} frames is ignored: COLMAP's perspective models have no such term."
        findings.append(Finding("ignored-distortion", text))
    if repeated:
        repeats = agreeing(repeated, "repeats another and is", "repeat others and are")
        text = f"{counted(repeated, 'frame')} of {path.name} {repeats} left out."
        findings.append(Finding("duplicate-frames", text))
    findings += unusable_findings(unusable, len(images))
    return Transforms(
        path, meta, tuple(images.values()), tuple(kept), tuple(cameras.values()), image_dir,
        applied, tuple(findings), tuple(unusable),
    )  # fmt: skip


def _check_repeated(where: str, first: Image, again: Image) -> None:
    same = np.allclose(first.quat, again.quat) and np.allclose(first.translation, again.translation)
    if not same or first.intrinsics != again.intrinsics:
        expected = f"{where} to have an image of its own"
        raise SceneFormatError(expected, found=f"{again.name!r} again, elsewhere", fix=FIX)


def apply_transform(
    transform: Float64[np.ndarray, "3 4"], xyz: np.ndarray
) -> Float64[np.ndarray, "N 3"]:
    """Apply an affine map [3, 4] to points [N, 3] in float64."""
    with np.errstate(invalid="ignore"):  # infinite points stay infinite or NaN
        return np.asarray(np.asarray(xyz, np.float64) @ transform[:, :3].T + transform[:, 3])


def _number(where: str, values: Mapping[str, Any], key: str, default: float | None = None) -> float:
    value, number = values.get(key, default), math.nan
    with suppress(TypeError, ValueError, OverflowError):
        number = float(value) if not isinstance(value, bool) else math.nan
    if not math.isfinite(number):
        other = "none" if value is None else repr(value)
        kind = NotFiniteError if isinstance(value, float) else SceneFormatError
        raise kind(f"a number {key} in {where}", found=other, fix=FIX)
    return number


def _merged(shared: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a frame over those that all frames share.

    As in instant-ngp, focal lengths and lens models of the frame replace those of the file, however
    either are stated. Shared intrinsics are in pixels of the shared size; a frame of another size
    has resized ones.
    """
    stated = {key: value for key, value in own.items() if value is not None}
    size, own_size = ([each.get(key) for key in ("w", "h")] for each in (shared, stated))
    resized = dict[str, Any]()
    if all(_is_positive(each) for each in (*size, *own_size)):
        ratio = np.array(own_size, np.float64) / np.array(size, np.float64)
        resized = {f"c{axis}": ratio[i] for i, axis in enumerate("xy")}
        if abs(ratio[0] / ratio[1] - 1) <= ASPECT_SLACK:  # else cropped
            resized |= {f"fl_{axis}": ratio[i] for i, axis in enumerate("xy")}
    replaced = set[str]()
    if stated.keys() & _FOCAL_LENGTHS["x"]:
        replaced |= _ANY_FOCAL_LENGTH  # square pixels, unless stated too
    if stated.keys() & _FOCAL_LENGTHS["y"]:
        replaced |= _FOCAL_LENGTHS["y"]
    if stated.keys() & LENS_MODELS:
        model, other = lens_model(stated), lens_model(shared)
        if model != other and (model in UNDISTORTED or _FISHEYE in (model, other)):
            replaced |= {*LENS_MODELS, *DISTORTION}
    kept = {key: value for key, value in shared.items() if key not in replaced}
    kept |= {key: kept[key] * by for key, by in resized.items() if _is_positive(kept.get(key))}
    return {**kept, **stated}


def _is_positive(value: object) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and 0 < value < _MAX_PIXELS  # type: ignore[operator]


def lens_model(values: Mapping[str, Any]) -> str:
    """Return the name of a lens model; instant-ngp has a flag for fisheye lenses."""
    if values.get("is_fisheye") is True:
        return _FISHEYE
    return str(values.get("camera_model", "OPENCV"))


def _camera(
    where: str, values: Mapping[str, Any], file: Path
) -> tuple[str, int, int, tuple[float, ...]]:
    """Return COLMAP's model name, width, height and parameters of a frame's camera."""
    if values.get("w") is not None and values.get("h") is not None:
        width, height = int(_number(where, values, "w")), int(_number(where, values, "h"))
    else:
        expected = f"a readable image, or w and h to be, in {where}"
        with translate_errors(file, expected, fix=FIX), open_file(file) as opened:
            width, height = open_picture(opened).size
    bare = not any(values.get(key) is not None for key in (*LENS_MODELS, *_ANY_FOCAL_LENGTH))
    # Programs differ in what they write as a panorama's focal length; LichtFeld Studio takes what
    # states none, as Blender's panoramas do, for one.
    if lens_model(values) in _PANORAMAS or (bare and width == 2 * height):
        model, params = panorama(width, height)
        return model, width, height, params
    fl_x = _focal_length(where, values, "x", width, None)
    fl_y = _focal_length(where, values, "y", height, fl_x)
    center = _number(where, values, "cx", width / 2), _number(where, values, "cy", height / 2)
    model, params = _lens(where, values, (fl_x, fl_y), center)
    return model, width, height, params


def _focal_length(
    where: str, values: Mapping[str, Any], axis: str, size: int, default: float | None
) -> float:
    keys = f"{axis}_fov", f"fl_{axis}", f"camera_angle_{axis}"  # as instant-ngp prefers them
    key = next((key for key in keys if values.get(key) is not None), f"fl_{axis}")
    if values.get(key) is None and default is None:
        raise SceneFormatError(
            f"a focal length (fl_{axis} in pixels, or camera_angle_{axis} in radians) in {where}",
            found="none",
            fix="Add it to the file or to each frame; for panoramas, add "
            '"camera_model": "EQUIRECTANGULAR".',
        )
    focal_length = _number(where, values, key, default)
    if key != f"fl_{axis}":
        turn, unit = (360, "degrees") if key == f"{axis}_fov" else (2 * math.pi, "radians")
        if not 0 < focal_length < turn / 2:
            expected = f"a {key} between 0 and {'180' if turn == 360 else 'pi'}, in {unit}, in"
            raise NotFiniteError(f"{expected} {where}", found=f"{focal_length:g}", fix=FIX)
        focal_length = 0.5 * size / math.tan(math.pi * focal_length / turn)
    if not 0 < focal_length < math.inf:
        expected = f"a positive focal length fl_{axis} in {where}"
        raise NotFiniteError(expected, found=f"{focal_length:g}", fix=FIX)
    return focal_length


def _lens(
    where: str, values: Mapping[str, Any], focal: tuple[float, float], center: tuple[float, float]
) -> Lens:
    """Return COLMAP's model and parameters; COLMAP has no k4 for perspective lenses."""
    model = lens_model(values)
    k1, k2, k3, k4, p1, p2 = (_number(where, values, key, 0.0) for key in DISTORTION)
    if model == _FISHEYE:
        return fisheye(focal, center, (k1, k2, k3, k4))
    if model not in _PERSPECTIVE:
        raise SceneFormatError(
            f"a perspective, {_FISHEYE} or {_PANORAMAS[0]} camera_model in {where}",
            found=repr(model),
            fix="Convert the images to a perspective projection first.",
        )
    return brown(focal, center, (k1, k2, k3), (p1, p2))


def _matrix(where: str, value: Any) -> Float64[np.ndarray, "3 4"]:
    """Return the first three rows of a pose matrix; raise unless finite and not all zero."""
    matrix: np.ndarray = np.empty(0)
    with suppress(TypeError, ValueError, OverflowError):
        matrix = np.array(value, np.float64)
    fits = matrix.shape in {(3, 4), (4, 4)}
    if fits and not (np.isfinite(matrix[:3]).all() and matrix[:3, :3].any()):
        found = "only zeros" if np.isfinite(matrix[:3]).all() else "NaN or infinity"
        raise NotFiniteError(f"a matrix of finite numbers in {where}", found=found, fix=FIX)
    if not fits:
        found = "none" if value is None else "another shape"
        raise SceneFormatError(f"a matrix of 3 x 4 numbers in {where}", found=found, fix=FIX)
    return matrix[:3]


def _find_points(
    transforms: Transforms,
) -> tuple[PointCloud, Float64[np.ndarray, "N 3"], Path, list[Finding]]:
    """Find the points of a ``transforms.json``.

    They are those of the PLY that it names, else of a PLY known to be in the transforms' space,
    else of a COLMAP model, whose cameras determine the map into that space.

    Returns:
        The cloud, its positions in float64, its file, and findings.
    """
    root, findings = transforms.path.parent, list[Finding]()
    named = transforms.json.get("ply_file_path")
    names = [name for name in (named, *_POINT_FILES) if isinstance(name, str)]
    if isinstance(named, str) and not (root / named).is_file():
        text = f"ply_file_path {named} is {special_kind(root / named) or 'missing'}."
        findings.append(Finding("missing-points-file", text, subjects=(named,)))
    ply = next((root / name for name in names if (root / name).is_file()), None)
    if ply is not None:
        points, exact = read_ply_float64(ply)
        for name in (*names, "init.ply"):
            use = f"set it as ply_file_path in {transforms.path.name}"
            findings += differing_points(ply, points.xyz, root / name, use)
        return points, exact, ply, findings
    models = _models(root)
    if not models:
        return PointCloud.empty(), np.empty((0, 3)), root / _POINT_FILES[0], findings
    for model_dir in models[:-1]:  # the poses may come from a smaller model
        with suppress(SceneFormatError):
            return _points_of_model(transforms, model_dir, findings)
    return _points_of_model(transforms, models[-1], findings)


def _models(root: Path) -> list[Path]:
    """List the COLMAP models near a ``transforms.json``, most likely first."""
    places = (root / "colmap/sparse", root / "sparse")
    return next(filter(None, map(models_in, places)), [])


def _points_of_model(
    transforms: Transforms, model_dir: Path, findings: list[Finding]
) -> tuple[PointCloud, Float64[np.ndarray, "N 3"], Path, list[Finding]]:
    points, exact, _, points_path = read_model_points(model_dir)
    model_images = read_model_cameras(model_dir)[1]
    transform, doubts = _transform_of_model(transforms, model_dir, model_images)
    xyz = apply_transform(transform, exact)
    with np.errstate(over="ignore"):  # beyond float32's range: infinite, dropped later
        return points.replace(xyz=xyz.astype(np.float32)), xyz, points_path, findings + doubts


def _transform_of_model(
    transforms: Transforms, model_dir: Path, model_images: Sequence[Image]
) -> tuple[Float64[np.ndarray, "3 4"], list[Finding]]:
    """Find the map [3, 4] from the model's world that aligns its cameras with the frames'."""
    candidates = [_LEGACY_TRANSFORM, np.eye(4)[:3]]
    if transforms.applied_transform is not None:
        candidates = [transforms.applied_transform]
    elif model_dir.parts[-3:-2] != ("colmap",):  # not a folder that nerfstudio made
        candidates.reverse()
    pairs = pair_centers(
        *(
            [(im.name, im.camera.center) for im in each]
            for each in (transforms.images, model_images)
        )
    )
    if not pairs:
        doubt = f"no image of {model_dir} is in {transforms.path.name}: points may be misaligned."
        return candidates[0], [Finding("unrelated-models", doubt)]
    centers, model_centers = (np.array(each) for each in zip(*pairs, strict=True))
    extent = max(float(np.ptp(centers, axis=0).max()), 1e-6 * float(np.abs(centers).max()))
    maps: list[tuple[np.ndarray, list[Finding]]] = [(each, []) for each in candidates]
    fitted = fit_similarity(model_centers, centers)
    if fitted is not None and len(pairs) >= _MIN_FITTED:
        poses = f"The poses of {transforms.path.name} are a similarity transform of {model_dir}'s"
        by = f"(scale {fitted.scale:.3g}), as instant-ngp writes them"
        text = f"{poses} {by}; the points were transformed likewise."
        maps.append((fitted.matrix, [Finding("transformed-points", text, "info")]))
    for matrix, found in maps:
        off = np.abs(apply_transform(matrix, model_centers) - centers).max(axis=1)
        if np.median(off) <= _POSE_TOLERANCE * extent:
            return matrix, found
    raise SceneFormatError(
        f"the cameras of {model_dir} to be those of {transforms.path} after applied_transform",
        found=f"cameras {np.median(off):.3g} apart in a scene of extent {extent:.3g}",
        fix="Set ply_file_path to a PLY in the space of the poses, or load the COLMAP scene.",
    )


def pair_centers(named: Named, others: Named) -> list[tuple[Center, Center]]:
    """Pair camera centres by image path, else by file name, else by that without suffix.

    Names that are not unique have no pair.
    """
    for short in (lambda n: n.removeprefix("images/"), lambda n: PurePath(n).name, _stem):
        unique: list[dict[str, Center]] = []
        for each in (named, others):
            count = Counter(short(name) for name, _ in each)
            unique.append({short(name): at for name, at in each if count[short(name)] == 1})
        if pairs := [(at, unique[1][name]) for name, at in unique[0].items() if name in unique[1]]:
            return pairs
    return []


def _stem(name: str) -> str:
    return PurePath(name).stem
