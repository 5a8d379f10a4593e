"""Writing stereo's depth and normal maps: a COLMAP dense workspace, or a plain folder.

COLMAP places pixel (column, row) of a map at (column, row) of its camera, whereas everyone else,
its own sparse model included, has (column + 0.5, row + 0.5). Maps (mvs/mat.h) and consistency
graphs (mvs/consistency_graph.h), little-endian, begin with the text ``W&H&C&``; a map follows with
C x H x W float32, a graph with int32: column, row, n and n image indices (places in the model,
ascending by id) for each pixel that has any. Promise: depths are those along COLMAP's rays, so
fused points lie where the scene has them; no depth is mixed with its neighbours'.
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
from splatseed.io.photograph_checks import Size, check_sizes
from splatseed.io.staging import MANIFEST, output_folder, write_json
from splatseed.io.write import bring, image_folders
from splatseed.lens import rays_through
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, in_threads, silent
from splatseed.scene import Image, Observations, Scene, Tracks

DenseMap: TypeAlias = Any
"""A ``splatseed.depth.stereo.StereoMap``: name, camera, depth, normal, confidence, sources and
agreeing of one image."""
Undistort: TypeAlias = Callable[
    [UInt8[np.ndarray, "H W 3"], Intrinsics, Float64[np.ndarray, "3 3"]],
    tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]],
]
"""``splatseed.photos.projection.undistort`` or an equivalent: takes pixels, lens and matrix, and
returns pixels and which of them are known."""

_MAX_SOURCES = 8
"""``agreeing`` has one bit per source."""
_MAX_CHANGE = 1.25
"""Planes seen at so grazing an angle that depth changes by more than this factor are left out."""
_SAME_POSE = 1e-6
_KINDS = ("photometric", "geometric")
"""COLMAP's two passes; stereo_fusion reads the second unless told otherwise."""
_POINTS_PER_MAP = 200
"""Points of a map: enough to tell which views overlap much and which little."""
_GREY = 128


@dataclass(frozen=True)
class DenseReport:
    """What was written: maps, their pixels, those with a depth, and images without any."""

    path: Path
    num_maps: int = 0
    num_pixels: int = 0
    num_known: int = 0
    empty: tuple[str, ...] = ()

    @property
    def share_known(self) -> float:
        """The share of pixels with a depth, 0 to 1."""
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
    """Write a folder of depth maps of kind "z"; ``splatseed.io.find_depths`` reads them.

    Beside the planar depth of the image ``a/b.jpg``, ``a/b.jpg.npy``, the rest is in
    ``a/b.jpg.stereo.npz``.

    Args:
        scene: The scene of the maps.
        maps: The maps of some of its images, in any order and of any size; consumed one by one.
        path: The folder to make.
        overwrite: Whether an earlier output of splatseed may be replaced.
        provenance: How the maps came about, for ``splatseed.json``.
        progress: Called with the stage and the fraction done.

    Raises:
        ParameterError: There is no map, or one does not belong to the scene.
        OutputError: The folder is taken or cannot be written.
    """
    path, images = Path(path), {image.name: image for image in scene.images}
    protect = scene.source.inputs if scene.source else ()
    folder = depth_folder(path, "z", overwrite=overwrite, protect=protect, provenance=provenance)
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
    """Write a folder that ``colmap stereo_fusion --workspace_path`` turns into a point cloud.

    A map is written under both of COLMAP's names, photometric and geometric, and once more as
    ``.npy`` with depths at pixel centres, which ``find_depths`` prefers.

    Args:
        scene: A scene with photographs.
        maps: As for ``write_dense_maps``, as are all arguments and errors not named here.
        path: The folder to make.
        copy_images: Copy the photographs instead of linking them.
        undistort: Removes lens distortion from a photograph; the workspace then holds the
            undistorted photographs and pinhole cameras of the same matrix, which the maps belong
            to. Without it, distorted cameras are refused.

    Raises:
        InputError: What ``check_dense_scene`` refuses.
    """
    path, sizes = Path(path), check_dense_scene(scene, undistorts=undistort is not None)
    cameras, images = _photograph_model(scene, sizes)
    idxs = {name: idx for idx, name in enumerate(images)}
    inputs = scene.source.inputs if scene.source else ()
    with output_folder(path, kind="depth", overwrite=overwrite, protect=inputs) as folder:
        _bring_photographs(scene, folder, undistort, progress, copy=copy_images)
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
        # Which images to match with which, and which to fuse, in the model's order.
        names = [name for name in images if name in sources]
        matches = [f"{name}\n{_matches(sources[name])}\n" for name in names]
        (stereo / "patch-match.cfg").write_text("".join(matches), encoding="utf-8")
        (stereo / "fusion.cfg").write_text("".join(f"{n}\n" for n in names), encoding="utf-8")
        # The finite, distinct points with tracks; added points have none.
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
    """Width and height of each photograph, by name, of a scene that can become a workspace.

    Raises:
        SceneNotFoundError: It has no photographs, or one is missing.
        SceneFormatError: A camera has distortion that stays (not ``undistorts``), or a photograph
            differs from it in aspect ratio.
        OutputError: An image's name leads out of its folder.
    """
    folder = photograph.photograph_folder(scene)
    return {image.name: _size_of(image, folder, undistorts=undistorts) for image in scene.images}


def _size_of(image: Image, folder: Path, *, undistorts: bool) -> Size:
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
            "photographs that can be written again once they are undistorted (.jpg, .png, .tif)",
            found=image.name,
            fix="Export them as one of these, or undistort the scene first.",
        )
    if "/".join(safe_parts(image.name)) != image.name or "\n" in image.name:
        expected = "image names that stay inside their folder"
        raise OutputError(expected, found=repr(image.name), fix="Rename the image.")
    return check_sizes([image], folder)[image.name]


def _write_each(
    maps: Iterable[DenseMap],
    images: Mapping[str, Image],
    write: Callable[[DenseMap], None],
    path: Path,
    progress: Progress,
) -> DenseReport:
    """Check and write the maps one by one."""
    report, total = DenseReport(path), length_hint(maps, len(images)) or 1
    seen = set[str]()
    for dense in maps:
        _check_map(dense, images)
        if dense.name in seen:
            raise ParameterError(
                "one depth map per image", found=f"two for {dense.name}", fix="Leave one out."
            )
        seen.add(dense.name)
        write(dense)
        known = int(np.count_nonzero(np.isfinite(dense.depth)))
        empty = report.empty if known else tuple(sorted((*report.empty, dense.name)))
        pixels = report.num_pixels + dense.depth.size
        report = DenseReport(path, len(seen), pixels, report.num_known + known, empty)
        progress("write maps", min(len(seen) / total, 1.0))
    if not seen:
        raise ParameterError("at least one depth map", found="none", fix="Make some first.")
    return report


def _check_map(dense: DenseMap, images: Mapping[str, Image]) -> None:
    """Check that a map belongs to an image of the scene, and that its arrays match."""
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
    """The pinhole matrix of a camera whose image is resized to ``width`` x ``height``, [3, 3]."""
    scaled: np.ndarray = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
    return scaled


def depth_along(
    dense: DenseMap, K: Float64[np.ndarray, "3 3"], at: float
) -> Float32[np.ndarray, "H W"]:
    """The depth of each pixel's plane along another ray nearby; NaN where unknown.

    Pixel (column, row) gets that along the ray through (column + at, row + at) of the grid of K.
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
    """The product n . r of each pixel's normal and the ray through (column + at, row + at)."""
    height, width = dense.depth.shape
    rows, columns = np.mgrid[0:height, 0:width] + at
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T
    return np.asarray(np.einsum("hwc,hwc->hw", dense.normal.astype(np.float64), rays))


def _write_stereo(folder: Path, camera: Camera, dense: DenseMap, sources: Sequence[int]) -> None:
    """Write one map into the folder ``stereo``."""
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
    """The line of sources; COLMAP's own choice if there are none or a comma would split names."""
    if not sources or any("," in name for name in sources):
        return "__auto__, 20"
    return ", ".join(sources)


def write_map(path: Path, values: Float32[np.ndarray, "H W *C"]) -> None:
    """Write a new file of depths [H, W] or normals [H, W, 3]; NaN becomes 0, "unknown"."""
    height, width = values.shape[:2]
    planes = np.moveaxis(values.reshape(height, width, -1), -1, 0)
    known = np.nan_to_num(planes, nan=0.0).astype("<f4")
    _write(path, (width, height, len(planes)), known.tobytes())


def write_consistency_graph(
    path: Path, agreeing: UInt8[np.ndarray, "H W"], image_idxs: Sequence[int]
) -> None:
    """Write a new file of which images confirm each pixel: bit k stands for ``image_idxs[k]``."""
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


def _bring_photographs(
    scene: Scene, folder: Path, undistort: Undistort | None, progress: Progress, *, copy: bool
) -> None:
    """Fill ``images`` in a folder with the photographs of a scene that was checked."""
    bent = [image for image in scene.images if image.intrinsics.has_distortion]
    source = scene.source.image_dir if scene.source else None
    if undistort is None or not bent or source is None:
        folders = image_folders(scene)
        wanted = {n: p for n, p in folders.items() if n == "images" or n.startswith("images/")}
        bring(wanted, folder, copy=copy)
        return
    straight = [image.name for image in scene.images if not image.intrinsics.has_distortion]
    bring({f"images/{name}": source / name for name in straight}, folder, copy=copy)

    def work(start: int, stop: int) -> None:
        for image in bent[start:stop]:
            path, target = source / image.name, folder / "images" / image.name
            encoded = photograph.photograph_bytes(path)
            pixels = np.asarray(photograph.decode_photograph(path, encoded, scene.white))
            lens = image.intrinsics.resized(*pixels.shape[1::-1])
            straight = PilImage.fromarray(undistort(pixels, lens, lens.K)[0])
            target.parent.mkdir(parents=True, exist_ok=True)
            jpeg = PilImage.registered_extensions()[target.suffix.lower()] == "JPEG"
            # The pixels of a JPEG come from one already.
            options: dict[str, Any] = {"quality": 95, "subsampling": 0} if jpeg else {}
            straight.save(target, **options)

    in_threads(work, len(bent), 1, "undistort", progress)


def _photograph_model(
    scene: Scene, sizes: Mapping[str, Size]
) -> tuple[tuple[Intrinsics, ...], dict[str, Image]]:
    """The pinhole cameras and the images, by id, in pixels of the photographs as on disk.

    A record may be larger than its photographs (a folder of reduced copies), and COLMAP samples
    colours at the record's pixels: there is one for each camera and size of photograph.
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
            if lens.has_distortion:  # a feature that no ray of the lens reaches stays
                straight = rays_through(lens, uv) * lens.K[[0, 1], [0, 1]] + lens.K[:2, 2]
                uv = np.where(np.isnan(straight), uv, straight)
            scale = np.array([record.width / lens.width, record.height / lens.height])
            seen = Observations(uv * scale, seen.point_ids)
        images[image.name] = replace(image, intrinsics=record, observations=seen)
    return tuple(cameras.values()), images


def _overlap_points(dense: DenseMap, views: Sequence[int]) -> tuple[np.ndarray, list[list[int]]]:
    """Points [n, 3] evenly over a map's pixels that a source confirms, and the views of each."""
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
    """Points of the maps with tracks, and the images with features where they see them."""
    xyz = np.concatenate([np.empty((0, 3)), *(xyz for xyz, _ in overlap)])
    views = [seen for _, each in overlap for seen in each]
    lengths = np.array([len(seen) for seen in views], np.int64)
    image_idx = np.array([idx for seen in views for idx in seen], np.int64)
    point_idx = np.repeat(np.arange(len(xyz)), lengths)
    places, featured = np.empty(len(image_idx), np.uint32), []
    for idx, image in enumerate(images):
        mine = np.flatnonzero(image_idx == idx)
        places[mine], seen = np.arange(len(mine)), point_idx[mine]
        uv = np.nan_to_num(image.camera.project(xyz[seen])[0])  # perhaps behind it: a wrong map
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
