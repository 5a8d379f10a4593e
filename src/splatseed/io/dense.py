"""Write stereo depth and normal maps as a COLMAP dense workspace or a plain folder.

COLMAP's dense tools put the centre of pixel (column, row) at (column, row), whereas its sparse
model and other tools use (column + 0.5, row + 0.5). Maps (mvs/mat.h) and consistency graphs
(mvs/consistency_graph.h) are little-endian and start with the text ``W&H&C&``. A map continues with
C x H x W float32; a graph with int32 column, row, n and n image indices (in the model's order of
ids) per confirmed pixel. Promise: depths are along COLMAP's rays, so that fused points have the
scene's positions; depths are never interpolated between pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import length_hint
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from PIL import Image as PilImage

from splatseed.camera import Camera, Intrinsics
from splatseed.errors import OutputError, ParameterError, SceneFormatError
from splatseed.io import colmap, photograph
from splatseed.io.cleaning import clean_scene, renumber
from splatseed.io.depth_maps import depth_folder, safe_parts
from splatseed.io.files import StrPath
from splatseed.io.image_folders import image_folders, link_folders
from splatseed.io.photograph_checks import Size, check_sizes
from splatseed.io.staging import MANIFEST, output_folder, write_json
from splatseed.lens import unproject_pixels
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, in_threads, silent
from splatseed.projection import denormalized, normalized, pixel_centers
from splatseed.scene import Image, Scene
from splatseed.tracks import Observations, Tracks

DenseMap: TypeAlias = Any
"""A ``splatseed.depth.stereo.StereoMap`` of one image."""
Undistort: TypeAlias = Callable[
    [UInt8[np.ndarray, "H W 3"], Intrinsics, Float64[np.ndarray, "3 3"]],
    tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]],
]
"""``splatseed.photos.projection.undistort``: (pixels, camera, K) to (pixels, valid mask)."""

_MAX_SOURCES = 8
"""``agreeing`` has one bit per source."""
_MAX_CHANGE = 1.25
"""Largest change of depth by half a pixel; planes at more grazing angles are dropped."""
_SAME_POSE = 1e-6
_KINDS = ("photometric", "geometric")
"""COLMAP's two passes; stereo_fusion reads the second by default."""
_POINTS_PER_MAP = 200
"""Points per map in the sparse model, from which COLMAP derives the overlap of views."""
_GREY = 128


@dataclass(frozen=True)
class DenseReport:
    """Counts of written maps, pixels and pixels with depth; ``empty`` are maps without any."""

    path: Path
    num_maps: int = 0
    num_pixels: int = 0
    num_known: int = 0
    empty: tuple[str, ...] = ()

    @property
    def share_known(self) -> float:
        """Share of pixels with a depth, 0 to 1."""
        return self.num_known / max(self.num_pixels, 1)


def write_dense_maps(
    scene: Scene,
    maps: Iterable[DenseMap],
    path: StrPath,
    *,
    overwrite: bool = False,
    provenance: Mapping[str, object] | None = None,
    progress: Progress = silent,
) -> DenseReport:
    """Write a folder of planar depth maps for ``splatseed.io.find_depths``.

    The depth of ``a/b.jpg`` is in ``a/b.jpg.npy``, all else in ``a/b.jpg.stereo.npz``.

    Args:
        scene: The scene of the maps.
        maps: Maps of some of its images, in any order and size; consumed one by one.
        path: The output folder.
        overwrite: Replace an earlier output of splatseed.
        provenance: How the maps were made, for ``splatseed.json``.
        progress: Called with the stage and the fraction done.

    Raises:
        ParameterError: No map, or one does not belong to the scene.
        OutputError: The folder exists or cannot be written.
    """
    path, images = Path(path), {image.name: image for image in scene.images}
    inputs = scene.source.inputs
    folder = depth_folder(path, "z", overwrite=overwrite, protect=inputs, provenance=provenance)
    with folder as writer:

        def write(dense: DenseMap) -> None:
            height, width = dense.depth.shape
            K = scaled_K(images[dense.name].camera, width, height)  # as readers scale it
            writer.write(dense.name, depth_along(dense, K, 0.5))
            np.savez(
                writer.folder.joinpath(*safe_parts(f"{dense.name}.stereo.npz")),
                normal=np.asarray(dense.normal, np.float32),
                confidence=np.asarray(dense.confidence, np.float32),
                agreeing=np.asarray(dense.agreeing, np.uint8),
                sources=np.array(dense.sources, np.str_),
                K=np.asarray(dense.camera.K, np.float64),
            )

        return _write_each(maps, images, write, path, progress)


def write_dense_workspace(  # noqa: D417  (the rest is as for maps)
    scene: Scene,
    maps: Iterable[DenseMap],
    path: StrPath,
    *,
    overwrite: bool = False,
    copy_images: bool = False,
    undistort: Undistort | None = None,
    provenance: Mapping[str, object] | None = None,
    progress: Progress = silent,
) -> DenseReport:
    """Write a workspace for ``colmap stereo_fusion --workspace_path``.

    Each map gets both of COLMAP's names, photometric and geometric, and is also written as ``.npy``
    with depths at pixel centres, which ``find_depths`` prefers.

    Args:
        scene: A scene with photographs.
        maps: Maps; this and arguments and errors not listed are those of ``write_dense_maps``.
        path: The output folder.
        copy_images: Copy the photographs instead of linking them.
        undistort: Undistorts a photograph. The workspace then has undistorted photographs and
            pinhole cameras with the same K, to which the maps belong. If None, cameras with
            distortion are refused.

    Raises:
        InputError: As ``check_dense_scene``.
    """
    path, sizes = Path(path), check_dense_scene(scene, undistorts=undistort is not None)
    cameras, images = _photograph_model(scene, sizes)
    idxs = {name: idx for idx, name in enumerate(images)}
    inputs = scene.source.inputs
    with output_folder(path, kind="depth", overwrite=overwrite, protect=inputs) as folder:
        _write_photographs(scene, folder, undistort, progress, copy=copy_images)
        stereo = folder / "stereo"
        for name in ("depth_maps", "normal_maps", "consistency_graphs"):
            (stereo / name).mkdir(parents=True)
        sources: dict[str, tuple[str, ...]] = {}
        overlap: list[tuple[np.ndarray, list[list[int]]]] = []

        def write(dense: DenseMap) -> None:
            sources[dense.name] = dense.sources
            views = [idxs[name] for name in (dense.name, *dense.sources)]
            _write_stereo(stereo, images[dense.name].camera, dense, views[1:])
            overlap.append(_overlap_points(dense, views))

        progress("write maps", 0.0)
        report = _write_each(maps, images, write, path, progress)
        # Image pairs to match, and images to fuse, in the model's order.
        names = [name for name in images if name in sources]
        matches = [f"{name}\n{_matches(sources[name])}\n" for name in names]
        (stereo / "patch-match.cfg").write_text("".join(matches), encoding="utf-8")
        (stereo / "fusion.cfg").write_text("".join(f"{n}\n" for n in names), encoding="utf-8")
        # Only points with tracks; added points have none.
        points = scene.points.select(slice(0, len(scene.tracks or ())))
        originals = clean_scene(replace(scene, points=points, images=tuple(images.values())))
        points, (tracks, featured, _) = originals.points, renumber(originals)
        if tracks is None or not len(tracks.image_ids):
            points, tracks, featured = _overlap_model(overlap, tuple(images.values()))
        (folder / "sparse").mkdir()
        colmap.write_cameras(folder / "sparse/cameras.bin", cameras)
        colmap.write_images(folder / "sparse/images.bin", featured)
        colmap.write_points3d(folder / "sparse/points3D.bin", points, tracks)
        write_json(folder / MANIFEST, dict(provenance or {}))
    return report


def check_dense_scene(scene: Scene, *, undistorts: bool = False) -> dict[str, Size]:
    """Check that a scene can become a workspace; return the sizes of its photographs by name.

    Raises an ``InputError`` if a photograph is missing or does not fit, a camera has distortion
    without ``undistorts``, or an image name leads out of the folder.
    """
    photograph.photograph_folder(scene)  # raises if there is none
    return {image.name: _size_of(image, undistorts=undistorts) for image in scene.images}


def _size_of(image: Image, *, undistorts: bool) -> Size:
    lens = image.intrinsics
    if lens.has_distortion and not undistorts:
        raise SceneFormatError(
            "cameras without lens distortion (PINHOLE), as COLMAP's dense tools need them",
            found=f"{lens.model} for {image.name}",
            fix="Undistort the scene first: splatseed undistort SCENE -o OUT.",
        )
    kind = PilImage.registered_extensions().get(Path(image.name).suffix.lower())
    if lens.has_distortion and kind not in PilImage.SAVE:
        raise SceneFormatError(
            "photographs in a format that can be written after undistortion (.jpg, .png, .tif)",
            found=image.name,
            fix="Convert them, or undistort the scene first.",
        )
    if "/".join(safe_parts(image.name)) != image.name or "\n" in image.name:
        expected = "image names inside their folder"
        raise OutputError(expected, found=repr(image.name), fix="Rename the image.")
    return check_sizes([image])[image.name]


def _write_each(
    maps: Iterable[DenseMap],
    images: Mapping[str, Image],
    write: Callable[[DenseMap], None],
    path: Path,
    progress: Progress,
) -> DenseReport:
    report, total = DenseReport(path), length_hint(maps, len(images)) or 1
    seen = set[str]()
    for dense in maps:
        _check_map(dense, images)
        if dense.name in seen:
            raise ParameterError(
                "one depth map per image", found=f"two for {dense.name}", fix="Remove one."
            )
        seen.add(dense.name)
        write(dense)
        known = int(np.count_nonzero(np.isfinite(dense.depth)))
        empty = report.empty if known else tuple(sorted((*report.empty, dense.name)))
        pixels = report.num_pixels + dense.depth.size
        report = DenseReport(path, len(seen), pixels, report.num_known + known, empty)
        progress("write maps", min(len(seen) / total, 1.0))
    if not seen:
        raise ParameterError("at least one depth map", found="none", fix="Make maps first.")
    return report


def _check_map(dense: DenseMap, images: Mapping[str, Image]) -> None:
    unknown = [name for name in (dense.name, *dense.sources) if name not in images]
    size = (dense.camera.height, dense.camera.width)
    arrays = (dense.depth, dense.normal[..., 0], dense.confidence, dense.agreeing)
    wrong = [each.shape for each in arrays if each.shape != size]
    if unknown:
        expected, found = "images of the scene", ", ".join(unknown[:3])
    elif len(dense.sources) > _MAX_SOURCES:
        expected, found = f"at most {_MAX_SOURCES} sources", f"{len(dense.sources)}"
    elif wrong:
        expected, found = f"arrays of its camera's size, {size}", f"{wrong[0]}"
    else:
        pose = images[dense.name].camera.cam_from_world
        tolerance = _SAME_POSE * max(1.0, float(np.abs(pose).max()))
        if np.allclose(dense.camera.cam_from_world, pose, atol=tolerance):
            return
        expected, found = "the pose of its image", "another"
    expected = f"the map of {dense.name} to have {expected}"
    raise ParameterError(expected, found=found, fix="Make the maps from this scene.")


def scaled_K(camera: Camera, width: int, height: int) -> Float64[np.ndarray, "3 3"]:  # noqa: N802  (K is the field's name)
    """Return K [3, 3] of a camera for an image resized to ``width`` x ``height``."""
    scaled: np.ndarray = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
    return scaled


def depth_along(
    dense: DenseMap, K: Float64[np.ndarray, "3 3"], at: float
) -> Float32[np.ndarray, "H W"]:
    """Intersect each pixel's plane with the ray through (column + at, row + at) of K.

    Returns depths, NaN where unknown.
    """
    own = _toward_plane(dense, dense.camera.K, 0.5)
    other = _toward_plane(dense, K, at)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = own / other  # n . (d r) = n . (d' r'), so d' = d (n . r) / (n . r')
        near = (ratio < _MAX_CHANGE) & (ratio > 1 / _MAX_CHANGE)
    ratio = np.where(near, ratio, np.where(np.isfinite(own), np.nan, 1.0))  # no normal: unchanged
    return np.asarray(dense.depth * ratio, np.float32)


def _toward_plane(
    dense: DenseMap, K: Float64[np.ndarray, "3 3"], at: float
) -> Float64[np.ndarray, "H W"]:
    """Return n . r of each pixel's normal and the ray through (column + at, row + at)."""
    height, width = dense.depth.shape
    x, y = np.moveaxis(normalized(K, pixel_centers(height, width) + (at - 0.5)), -1, 0)
    nx, ny, nz = np.moveaxis(dense.normal.astype(np.float64), -1, 0)
    return np.asarray(nx * x + ny * y + nz)


def _write_stereo(folder: Path, camera: Camera, dense: DenseMap, sources: Sequence[int]) -> None:
    height, width = dense.depth.shape
    K = scaled_K(camera, width, height)  # as COLMAP scales it
    depth = depth_along(dense, K, 0.0)
    unknown = ~np.isfinite(depth)
    normal = np.where(unknown[..., None], np.float32(0), dense.normal)
    agreeing = np.where(unknown, np.uint8(0), dense.agreeing)
    for kind in _KINDS:
        file = f"{dense.name}.{kind}.bin"
        write_map(folder / "depth_maps" / file, depth)
        write_map(folder / "normal_maps" / file, normal)
        write_consistency_graph(folder / "consistency_graphs" / file, agreeing, sources)
    centred = folder / "depth_maps" / f"{dense.name}.npy"
    np.save(centred, depth_along(dense, K, 0.5), allow_pickle=False)


def _matches(sources: tuple[str, ...]) -> str:
    """Format the line of source views; ``__auto__`` without any, or if a name has a comma."""
    if not sources or any("," in name for name in sources):
        return "__auto__, 20"
    return ", ".join(sources)


def write_map(path: Path, values: Float32[np.ndarray, "H W *C"]) -> None:
    """Write depths [H, W] or normals [H, W, 3] to a new file; NaN becomes 0, COLMAP's "unknown"."""
    height, width = values.shape[:2]
    planes = np.moveaxis(values.reshape(height, width, -1), -1, 0)
    known = np.nan_to_num(planes, nan=0.0).astype("<f4")
    _write(path, (width, height, len(planes)), known.tobytes())


def write_consistency_graph(
    path: Path, agreeing: UInt8[np.ndarray, "H W"], image_idxs: Sequence[int]
) -> None:
    """Write the images that confirm each pixel to a new file; bit k means ``image_idxs[k]``."""
    bits = (agreeing[..., None] >> np.arange(len(image_idxs), dtype=np.uint8)) & 1
    rows, columns = np.nonzero(bits.any(axis=-1))
    confirming = bits[rows, columns].astype(bool)  # [pixels, sources]
    counts = confirming.sum(axis=1)
    idxs = np.broadcast_to(np.array(image_idxs, np.int64), confirming.shape)
    records = np.column_stack([columns, rows, counts, idxs])
    written = np.column_stack([np.ones((len(rows), 3), bool), confirming])
    height, width = agreeing.shape
    _write(path, (width, height, 1), records[written].astype("<i4").tobytes())


def _write(path: Path, size: tuple[int, int, int], body: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("xb") as file:
        file.write("".join(f"{each}&" for each in size).encode("ascii"))
        file.write(body)


def _write_photographs(
    scene: Scene, folder: Path, undistort: Undistort | None, progress: Progress, *, copy: bool
) -> None:
    """Link, copy or undistort a checked scene's photographs into ``images``."""
    distorted = [image for image in scene.images if image.intrinsics.has_distortion]
    if undistort is None or not distorted:
        folders = image_folders(scene)
        wanted = {n: p for n, p in folders.items() if n == "images" or n.startswith("images/")}
        link_folders(wanted, folder, copy=copy)
        return
    straight = [image for image in scene.images if not image.intrinsics.has_distortion]
    link_folders({f"images/{image.name}": image.path for image in straight}, folder, copy=copy)

    def work(start: int, stop: int) -> None:
        for image in distorted[start:stop]:
            target, lens = folder / "images" / image.name, image.lens
            straight = PilImage.fromarray(undistort(image.read(), lens, lens.K)[0])
            target.parent.mkdir(parents=True, exist_ok=True)
            jpeg = PilImage.registered_extensions()[target.suffix.lower()] == "JPEG"
            # High quality, since JPEG pixels are compressed a second time.
            options: dict[str, Any] = {"quality": 95, "subsampling": 0} if jpeg else {}
            straight.save(target, **options)

    in_threads(work, len(distorted), 1, "undistort", progress)


def _photograph_model(
    scene: Scene, sizes: Mapping[str, Size]
) -> tuple[tuple[Intrinsics, ...], dict[str, Image]]:
    """Return pinhole cameras and images, sorted by id, in pixels of the photographs on disk.

    COLMAP samples colours at camera pixels, but photographs may be reduced copies, so each pair of
    camera and photograph size gets a camera.
    """
    cameras: dict[tuple[int, Size], Intrinsics] = {}
    images = {}
    for image in sorted(scene.images, key=lambda image: image.image_id):
        lens, size, seen = image.intrinsics, sizes[image.name], image.observations
        (fx, _, cx), (_, fy, cy), _ = lens.resized(*size).K.tolist()
        pinhole = Intrinsics(len(cameras) + 1, "PINHOLE", *size, (fx, fy, cx, cy))
        record = cameras.setdefault((lens.camera_id, size), pinhole)
        if seen is not None:
            uv = seen.xy
            if lens.has_distortion:  # features outside of the lens model stay
                straight = denormalized(lens.K, unproject_pixels(lens, uv))
                uv = np.where(np.isnan(straight), uv, straight)
            scale = np.array([record.width / lens.width, record.height / lens.height])
            seen = Observations(uv * scale, seen.point_ids)
        images[image.name] = replace(image, intrinsics=record, observations=seen)
    return tuple(cameras.values()), images


def _overlap_points(dense: DenseMap, views: Sequence[int]) -> tuple[np.ndarray, list[list[int]]]:
    """Sample confirmed pixels of a map evenly; return points [n, 3] and the views of each."""
    rows, columns = np.nonzero(np.isfinite(dense.depth) & (dense.agreeing > 0))
    chosen = np.linspace(0, len(rows) - 1, min(_POINTS_PER_MAP, len(rows))).astype(np.intp)
    rows, columns = rows[chosen], columns[chosen]
    uv = np.stack([columns, rows], axis=1) + 0.5
    xyz = dense.camera.unproject(uv, dense.depth[rows, columns])
    seen = [
        [views[0], *(view for k, view in enumerate(views[1:]) if bits >> k & 1)]
        for bits in dense.agreeing[rows, columns].tolist()
    ]
    return xyz, seen


def _overlap_model(
    overlap: Sequence[tuple[np.ndarray, list[list[int]]]], images: Sequence[Image]
) -> tuple[PointCloud, Tracks, tuple[Image, ...]]:
    """Make a sparse model of the maps' points: cloud, tracks, and images with features."""
    xyz = np.concatenate([np.empty((0, 3)), *(xyz for xyz, _ in overlap)])
    views = [seen for _, each in overlap for seen in each]
    lengths = np.array([len(seen) for seen in views], np.int64)
    image_idx = np.array([idx for seen in views for idx in seen], np.int64)
    point_idx = np.repeat(np.arange(len(xyz)), lengths)
    places, featured = np.empty(len(image_idx), np.uint32), []
    for idx, image in enumerate(images):
        mine = np.flatnonzero(image_idx == idx)
        places[mine], seen = np.arange(len(mine)), point_idx[mine]
        uv = np.nan_to_num(image.camera.project(xyz[seen])[0])  # NaN behind a camera
        featured.append(replace(image, observations=Observations(uv, seen + 1)))
    tracks = Tracks(
        point_ids=np.arange(1, len(xyz) + 1),
        xyz=xyz,
        errors=np.full(len(xyz), colmap.UNKNOWN_ERROR),
        offsets=np.concatenate([[0], np.cumsum(lengths)]),
        image_ids=np.array([i.image_id for i in images], np.uint32)[image_idx],
        point2d_idx=places,
    )
    cloud = PointCloud(xyz.astype(np.float32), np.full(xyz.shape, _GREY, np.uint8))
    return cloud, tracks, tuple(featured)
