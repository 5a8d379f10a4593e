"""Folders of depth maps: match maps to images by name, read them on demand, write a folder.

``scale`` is stored units per scene unit; stored values are divided by it. For the image
``a/b.jpg``, the stems ``a/b.jpg``, ``a/b.jpg.geometric`` and ``.photometric`` (COLMAP's dense
stereo), ``a/depthN`` for ``a/frameN.jpg`` (NICE-SLAM; 3D Scanner App's have ``_`` before the
number), ``a/X.depth`` for ``a/X.color.png`` (7-Scenes), ``a/b`` and ``a/b_depth`` are tried in this
order, each with ``SUFFIXES``. The confidence of ``depth_N.png`` or ``frame_N.exr`` is
``conf_N.png``, that of ``depth/b.png`` is ``confidence/b.png`` beside the folder. Promise: maps are
float32 with NaN where unknown; reading is thread-safe.

Output of ``splatseed undistort`` and ``sfm`` has ``distorted.json``, with the original lenses: by
image name, ``model``, ``width``, ``height`` and ``params`` in COLMAP's terms. If the undistorted
photographs have another size, maps of the original size are undistorted on reading; if they have
another aspect ratio, so are a sensor's maps, which have confidences, of the original aspect ratio.
Other maps are taken to be made from the undistorted photographs, since a network's may have any
size.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.camera import Intrinsics
from splatseed.depthmap import DepthKind, DepthMap
from splatseed.errors import OutputError, SceneFormatError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io.camera_records import make_intrinsics
from splatseed.io.depth_files import KINDS, SUFFIXES, check_stored, read_confidence, read_stored
from splatseed.io.files import COPY_AGAIN, read_json, translate_errors
from splatseed.io.staging import MANIFEST, output_folder, write_json
from splatseed.lens import project_rays
from splatseed.projection import normalized, pixel_centers
from splatseed.scene import Scene
from splatseed.text import agreeing, counted, name_some

CAMERA_FILE = "cam_params.json"
"""Camera and depth scale of an RGB-D capture, in its folder or the parent."""
DESCRIPTION = "depths.json"
"""The file that describes the maps of a folder."""
LENSES = "distorted.json"
"""The file of the original lenses, in the folder of an undistorted scene."""
LINES = "depth_params.json"
"""Graphdeco's file of scales and offsets, by image name without suffix, beside a COLMAP model."""

DISTORTED_MAPS, WITHOUT_CONFIDENCE = "distorted-depth-maps", "depth-maps-without-confidence"
DEPTH_KIND = "depth-kind"
"""Kinds of findings about maps."""

_INTEGER_SCALE = 1000.0
"""Default scale of integer maps: millimetres in a scene in metres."""
_NO_HIT = 1e9
"""Values from here on mean that a renderer's ray hit nothing; Blender writes 1e10."""
_SATURATED = 65535
_LINE_DIVISOR = 2.0**16
"""Of stored values, whatever their bits, before a line applies."""
_FOLDERS = ("", "stereo/depth_maps", "depth_maps", "results", "depths", "depth", "keyframes/depth")
"""Subfolders searched for maps; the first with a match is used."""
_FRAME = re.compile(r"frame_?(\d+)", re.IGNORECASE)
_CAPTURED = re.compile(r"depth_?(\d+)", re.IGNORECASE)
_CONFIDENCE_FOLDER = "confidence"
"""The folder of confidence maps beside a folder of depth maps (Polycam, Stray Scanner)."""


@dataclass(frozen=True, eq=False)
class Undistortion:
    """Resamples maps of planar depth to the pixels of undistorted photographs."""

    lenses: Mapping[str, Intrinsics]  # by image name, of the photographs before undistortion
    cameras: Mapping[str, Intrinsics]  # of the undistorted ones, at the size of the result

    def apply(self, name: str, values: np.ndarray, unknown: float = np.nan) -> np.ndarray:
        """Resample a map [H, W] of the distorted camera to the pixels of a photograph [h, w].

        Pixels outside of the map become ``unknown``.
        """
        camera, lens = self.cameras[name], self.lenses[name]
        height, width = values.shape
        uv = project_rays(lens, normalized(camera.K, pixel_centers(camera.height, camera.width)))
        uv *= [width / lens.width, height / lens.height]
        inside = np.all((uv >= 0) & (uv < [width, height]), axis=-1)
        places = np.floor(np.where(inside[..., None], uv, 0)).astype(np.intp)
        moved = values[places[..., 1], places[..., 0]]
        return np.where(inside, moved, np.asarray(unknown, values.dtype))


@dataclass(frozen=True, eq=False)
class DepthFiles:
    """Depth maps in files; the type of ``Scene.depths`` of a loaded scene.

    Iterates over the names of images with a map, sorted.
    """

    paths: Mapping[str, Path]
    """The maps' files by image name."""
    kind: DepthKind | None = None
    """Meaning of the values; None: planar z."""
    scale: float | None = None
    """Stored units per scene unit; None: 1000 for integers, 1 for floats."""
    lens: Undistortion | None = None
    """Resamples maps for undistorted photographs; None: not needed."""
    confidences: Mapping[str, Path] = field(default_factory=dict)
    """Files of the maps' confidence by image name; of an image without one it is unknown."""
    in_scene_units: bool = False
    """Whether the maps come with a capture and share the unit of its poses."""
    lines: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Scale and offset from integers / 65536 to inverse depth in scene units, by image name
    (graphdeco's). Where there are any, the default kind is inverse depth."""

    def __contains__(self, name: object) -> bool:
        return name in self.paths

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self.paths))

    def __len__(self) -> int:
        return len(self.paths)

    def read(self, name: str) -> DepthMap:
        """Read the map of an image; thread-safe.

        Unknown pixels are NaN: stored NaN, infinity, values of 1e9 or more, 65535 in 16 bits (a
        sensor's limit), and values of 0 or less (for inverse depth, only integer zeros, since a
        network may predict 0 for far pixels).

        Raises:
            SceneNotFoundError: The image has no map, or its file is missing.
            SceneFormatError: The file is malformed.
            MissingDependencyError: An OpenEXR file, without the package OpenEXR.
        """
        path = self.paths.get(name)
        if path is None:
            fix = "Skip this image."
            raise SceneNotFoundError(f"a depth map of {name}", found="none", fix=fix)
        stored = read_stored(path)
        default: DepthKind = "inverse" if self.lines else "z"
        kind, is_integer = self.kind or default, stored.dtype.kind in "ui"
        divisor = self.scale or (_INTEGER_SCALE if is_integer else 1.0)
        line = self.lines.get(name) if kind == "inverse" else None
        with np.errstate(over="ignore", invalid="ignore"):  # becomes infinite, and so NaN
            values: np.ndarray = (stored / np.float64(divisor)).astype(np.float32)
            if line is not None:
                values = (line[0] * (stored / _LINE_DIVISOR) + line[1]).astype(np.float32)
            known = (np.abs(values) < _NO_HIT) & ((values > 0) | (kind == "inverse"))
        if is_integer and kind == "inverse":
            known &= stored != 0
        elif stored.dtype == np.uint16:
            known &= stored != _SATURATED
        values[~known] = np.nan
        confidence = self._confidence(name, values.shape)
        if self.lens is not None and name in self.lens.cameras:
            values = self.lens.apply(name, values)
            confidence = None if confidence is None else self.lens.apply(name, confidence, 0)
        return DepthMap(values, kind, confidence=confidence)

    def _confidence(self, name: str, shape: tuple[int, ...]) -> UInt8[np.ndarray, "H W"] | None:
        path = self.confidences.get(name)
        if path is None:
            return None
        confidence = read_confidence(path)
        if confidence.shape != shape:
            (height, width), size = shape, " x ".join(map(str, confidence.shape[::-1]))
            raise SceneFormatError(
                f"{path} to have the size of the depth map {self.paths[name].name}, "
                f"{width} x {height}",
                found=size,
                fix=f"{COPY_AGAIN[:-1]}; without it, confidence is unknown.",
            )
        return confidence


def match_by_name(scene: Scene, root: Path) -> DepthFiles | None:
    """Match the maps of a folder to a scene's images by name; None without a match."""
    for folder in (root / name for name in _FOLDERS):
        if not folder.is_dir() or not (paths := _match(scene, folder)):
            continue
        if (folder / DESCRIPTION).is_file():
            return DepthFiles(paths, *read_description(folder / DESCRIPTION))
        confidences = find_confidences(paths)
        example, scale = next(iter(paths.values())), None
        if _CAPTURED.fullmatch(example.stem) and example.suffix.lower() == ".png":
            camera = camera_file(folder, 2)
            scale = read_capture_scale(camera) if camera else None
        lines = _find_lines(scene, folder, paths)
        return DepthFiles(paths, scale=scale, confidences=confidences, lines=lines)
    return None


def _find_lines(
    scene: Scene, folder: Path, paths: Mapping[str, Path]
) -> dict[str, tuple[float, float]]:
    """Find the lines of graphdeco's inverse depth maps, without those of failed fits."""
    model, root = scene.source.model_dir, scene.source.root
    places = [place for place in (folder, folder.parent, model, root) if place is not None]
    path = next((place / LINES for place in places if (place / LINES).is_file()), None)
    if path is None or any(each.suffix.lower() != ".png" for each in paths.values()):
        return {}
    content = read_json(path)
    with translate_errors(path, "a scale and an offset per image", fix="Correct it."):
        lines = {
            name: (float(line["scale"]), float(line["offset"]))
            for name in paths
            if (line := content.get(name.rpartition(".")[0])) is not None
        }
    return {name: line for name, line in lines.items() if 0 < line[0] < np.inf > abs(line[1])}


def find_confidences(paths: Mapping[str, Path]) -> dict[str, Path]:
    """Find the confidence files of depth maps by image name; images without one are left out."""
    found = dict[str, Path]()
    for name, path in paths.items():
        places = [path.parent.parent / _CONFIDENCE_FOLDER / f"{path.stem}.png"]
        if number := _CAPTURED.fullmatch(path.stem) or _FRAME.fullmatch(path.stem):
            separator = "_" if "_" in path.stem else ""
            places.insert(0, path.with_name(f"conf{separator}{number[1]}.png"))
        if file := next((place for place in places if place.is_file()), None):
            found[name] = file
    return found


def write_lenses(folder: Path, lenses: Mapping[str, Intrinsics]) -> None:
    """Write the lenses of photographs with distortion, by image name, if there are any."""
    bent = {
        name: {"model": lens.model, "width": lens.width, "height": lens.height,
               "params": list(lens.params)}
        for name, lens in sorted(lenses.items())
        if lens.has_distortion
    }  # fmt: skip
    if bent:
        write_json(folder / LENSES, bent)


def fitted_to_undistorted(scene: Scene, maps: DepthFiles) -> DepthFiles:
    """Return maps with the undistortion that the scene's photographs have had, if they need it."""
    path = scene.source.root and scene.source.root / LENSES
    if path is None or not path.is_file() or maps.lens is not None:
        return maps
    images = [image for image in scene.images if image.name in maps]
    before = _read_lenses(path)
    cameras = {im.name: im.intrinsics for im in images if im.name in before}
    if not cameras:
        return maps
    name, camera = next(iter(cameras.items()))
    height, width = read_stored(maps.paths[name]).shape
    lens = before[name]
    same_size = (width, height) == (lens.width, lens.height) != (camera.width, camera.height)
    same_shape = (
        width * lens.height == height * lens.width
        and width * camera.height != height * camera.width
    )
    if not (same_size or (same_shape and maps.confidences)):
        return maps
    share = width / lens.width  # of a photograph's pixels
    reduced = {
        name: camera.resized(round(camera.width * share), round(camera.height * share))
        for name, camera in cameras.items()
    }
    return replace(maps, lens=Undistortion(before, reduced))


def _read_lenses(path: Path) -> dict[str, Intrinsics]:
    content = read_json(path)
    fix = "Undistort the scene again."
    with translate_errors(path, "lenses by image name, as splatseed undistort writes", fix=fix):
        return {
            name: make_intrinsics(
                f"{path}, {name}", 1, each["model"], each["width"], each["height"], each["params"]
            )
            for name, each in content.items()
        }


def map_findings(maps: object) -> list[Finding]:
    """Report how maps are read, and those without a confidence among others."""
    if not isinstance(maps, DepthFiles):
        return []
    findings = []
    if maps.lens is not None:
        text = (
            "Depth maps are those of the photographs before undistortion, and are undistorted on "
        )
        findings.append(Finding(DISTORTED_MAPS, f"{text}reading.", "info"))
    if maps.lines and maps.kind in (None, "inverse"):
        text = f"Depth maps are read as inverse depth: {LINES} has their scales and offsets."
        findings.append(Finding(DEPTH_KIND, text, "info"))
    return findings + _without_confidence(maps)


def _without_confidence(maps: DepthFiles) -> list[Finding]:
    if not maps.confidences:
        return []
    lacking = [name for name in maps if name not in maps.confidences]
    if not lacking:
        return []
    have = agreeing(len(lacking), "has no confidence and is", "have no confidence and are")
    which = name_some(lacking, 3)
    text = f"{len(lacking):,} of {counted(len(maps), 'depth map')} {have} used whole: {which}."
    return [Finding(WITHOUT_CONFIDENCE, text, subjects=tuple(lacking))]


def _match(scene: Scene, folder: Path) -> dict[str, Path]:
    """Match maps in one folder; leading folders of image names are dropped as needed."""
    parts = {image.name: safe_parts(image.name) for image in scene.images}
    taken, true_folder = set[Path](), cache(Path.resolve)
    if scene.source.image_dir:
        photographs = (image.path for image in scene.images)  # may be in this folder
        taken = {true_folder(path.parent) / path.name for path in photographs}
    listing = cache(lambda parents: _listing(folder.joinpath(*parents), taken))
    for drop in range(max(map(len, parts.values()), default=0)):
        owners: dict[Path, str] = {}
        for name, each in sorted(parts.items()):
            if each[drop:]:
                files = listing(each[drop:-1])
                keys = (stem + suffix for stem in _stems(each[-1]) for suffix in SUFFIXES)
                path = next((files[key] for key in keys if key in files), None)
                if path and (other := owners.setdefault(path, name)) != name:
                    raise SceneFormatError(
                        "a depth map of its own for each image",
                        found=f"{path} for {other} and for {name}",
                        fix=f"Give maps full names, with subfolders: {name}.npy or {name}.png.",
                    )
        if owners:
            return {name: path for path, name in owners.items()}
    return {}


def _listing(folder: Path, taken: Collection[Path]) -> dict[str, Path]:
    """List the maps of a folder by name, with suffixes in lower case and numbers also unpadded."""
    files: dict[str, Path] = {}
    if not folder.is_dir():
        return files
    true_folder = folder.resolve()
    for path in sorted(folder.iterdir(), reverse=True):  # .png before .PNG
        if path.suffix.lower() in SUFFIXES and true_folder / path.name not in taken:
            files.setdefault(path.stem + path.suffix.lower(), path)
    for key, path in list(files.items()):
        if number := _CAPTURED.match(key):
            files.setdefault(f"depth{int(number[1])}{key[number.end() :]}", path)
    return files


def _stems(file_name: str) -> Iterator[str]:
    """Yield the stems of an image's map, in order of preference."""
    stem = PurePosixPath(file_name).stem
    yield from (file_name, f"{file_name}.geometric", f"{file_name}.photometric")
    # Before the image's own stem, which the photograph itself may have here.
    if number := _FRAME.fullmatch(stem):
        yield f"depth{int(number[1])}"
    if stem.endswith(".color"):
        yield f"{stem.removesuffix('.color')}.depth"
    yield from (stem, f"{stem}_depth")


def read_description(path: Path) -> tuple[DepthKind | None, float | None]:
    """Read kind and scale of a ``depths.json``; None if not given."""
    content = read_json(path)
    with translate_errors(path, "a description of depth maps", fix="Correct it, or leave it out."):
        scale, kind = _scale_in(content), content.get("kind")
        if kind not in (None, *KINDS):
            raise ValueError(f"kind {kind!r}, not one of {', '.join(KINDS)}")
        return kind, scale


def camera_file(folder: Path, above: int = 1) -> Path | None:
    """Find the camera file of a capture in a folder or its ``above`` next parents."""
    places = (folder, *folder.resolve().parents[:above])
    return next((path for each in places if (path := each / CAMERA_FILE).is_file()), None)


def read_capture_scale(path: Path) -> float | None:
    """Read the stored units per metre of a ``cam_params.json``; None if not given."""
    content = read_json(path)
    with translate_errors(path, "the camera of a capture", fix="Correct it."):
        camera = content.get("camera") if isinstance(content, dict) else content
        return _scale_in({} if camera is None else camera)


def _scale_in(content: Any) -> float | None:
    if not isinstance(content, dict):
        raise TypeError
    scale = content.get("scale")
    number = isinstance(scale, int | float) and not isinstance(scale, bool)
    if scale is None or (number and 0 < scale < 1e300):
        return scale and float(scale)
    raise ValueError(f"scale {scale!r}, not a number above 0")


def safe_parts(name: str) -> tuple[str, ...]:
    """Split an image name into parts, without those that lead out of a folder (``..``, ``/``)."""
    pure = PurePosixPath(name)
    return tuple(part for part in pure.parts if part not in {"..", pure.anchor})


def write_description(folder: Path, kind: DepthKind, scale: float = 1.0, **more: object) -> None:
    """Write ``depths.json`` into a folder of maps; ``more`` is informative only."""
    write_json(folder / DESCRIPTION, {"kind": kind, "scale": scale, **more})


@dataclass(frozen=True)
class DepthWriter:
    """Writes maps into a staged folder."""

    folder: Path

    def write(self, name: str, values: Float32[np.ndarray, "H W"]) -> None:
        """Write the map of one image, NaN where unknown; thread-safe."""
        path = self.folder.joinpath(*safe_parts(f"{name}.npy"))
        with translate_errors(path, "a depth map"):
            check_stored(values.shape, values.dtype)
        if path.exists():
            expected = "one depth map per image"
            raise OutputError(expected, found=f"two for {name}", fix="Rename the image.")
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.ascontiguousarray(values, np.float32))


@contextmanager
def depth_folder(
    path: Path,
    kind: DepthKind,
    *,
    overwrite: bool = False,
    protect: tuple[Path, ...] = (),
    provenance: Mapping[str, object] | None = None,
) -> Iterator[DepthWriter]:
    """Write a folder of depth maps, which appears when the block succeeds.

    ``provenance`` (how the maps were made) goes to ``splatseed.json``; other arguments and errors
    are those of ``output_folder``.
    """
    with output_folder(path, kind="depth", overwrite=overwrite, protect=protect) as partial:
        yield DepthWriter(partial)
        write_description(partial, kind)
        write_json(partial / MANIFEST, dict(provenance or {}))
