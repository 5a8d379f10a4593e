"""The photographs and the sparse model of a COLMAP dense workspace.

Notation: cameras are pinhole ones in the photographs' own pixels; that of an undistorted photograph
has the lens's own focal length, centre and size. COLMAP numbers images by their place in the model,
here ascending by image id. Promise: photographs are linked or copied, and never written to;
undistorted ones keep their names and file types. The points are the originals with their tracks;
where there are no tracks, points from the maps stand in, because COLMAP learns only from tracks
which images overlap.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from splatseed.camera import Camera, Intrinsics
from splatseed.errors import OutputError, SceneFormatError
from splatseed.io.cleaning import clean_scene
from splatseed.io.colmap import binary as colmap_binary
from splatseed.io.colmap.model import Renumbered, renumber
from splatseed.io.depth_maps import safe_parts
from splatseed.io.layouts import bring, image_folders
from splatseed.io.photograph import decode_photograph, open_photograph, photograph_bytes
from splatseed.lens import rays_through
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, in_threads
from splatseed.scene import Image, Observations, Scene, Tracks

Size = tuple[int, int]
"""Width and height in pixels."""
Undistort: TypeAlias = Callable[
    [UInt8[np.ndarray, "H W 3"], Intrinsics, Float64[np.ndarray, "3 3"]],
    tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]],
]
"""``splatseed.views.undistortion.undistort`` or an equivalent: takes pixels, lens and matrix, and
returns pixels and which of them are known."""

_ASPECT_SLACK = 0.02
_PER_MAP = 200
"""Points of a map: enough to tell which views overlap much and which little."""
_GREY = 128
_UNKNOWN_ERROR = -1.0


def scaled_K(camera: Camera, width: int, height: int) -> Float64[np.ndarray, "3 3"]:  # noqa: N802  (K is the field's name)
    """The pinhole matrix of a camera whose image is resized to ``width`` x ``height``, [3, 3]."""
    scaled: np.ndarray = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
    return scaled


def check_image(image: Image, folder: Path, *, undistorts: bool) -> Size:
    """Check that a photograph can be used, and return its width and height.

    Raises:
        SceneNotFoundError: It is missing.
        SceneFormatError: It has distortion that cannot be undone, or is not of its camera's shape.
        OutputError: Its name leads out of its folder.
    """
    from PIL import Image as PilImage  # noqa: PLC0415  (slow to import)

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
        raise OutputError(
            "image names that stay inside their folder",
            found=repr(image.name),
            fix="Rename the image.",
        )
    path = folder / image.name
    size = open_photograph(path, photograph_bytes(path)).size
    if abs(size[0] / size[1] / (lens.width / lens.height) - 1) > _ASPECT_SLACK:
        raise SceneFormatError(
            f"{path} to have the shape of its camera, {lens.width} x {lens.height}",
            found=f"{size[0]} x {size[1]}",
            fix="Use the images that the model was made from, or a resized copy of them.",
        )
    return size


def bring_photographs(
    scene: Scene, folder: Path, undistort: Undistort | None, progress: Progress, *, copy: bool
) -> None:
    """Fill ``images`` in a folder.

    Args:
        scene: Of checked images.
        folder: The workspace.
        undistort: Removes lens distortion; None if there is none.
        progress: Called with the stage and the fraction done.
        copy: Whether to copy rather than link.
    """
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
            _write_undistorted(image, source / image.name, folder / "images", undistort)

    in_threads(work, len(bent), 1, "undistort", progress)


def _write_undistorted(image: Image, path: Path, folder: Path, undistort: Undistort) -> None:
    from PIL import Image as PilImage  # noqa: PLC0415  (slow to import)

    pixels = np.asarray(decode_photograph(path, photograph_bytes(path)))
    height, width = pixels.shape[:2]
    straight, _ = undistort(pixels, image.intrinsics, scaled_K(image.camera, width, height))
    target = folder / image.name
    target.parent.mkdir(parents=True, exist_ok=True)
    if PilImage.registered_extensions()[target.suffix.lower()] == "JPEG":
        # The pixels come from JPEGs already.
        PilImage.fromarray(straight).save(target, quality=95, subsampling=0)
    else:
        PilImage.fromarray(straight).save(target)


class OverlapPoints:
    """Points sampled from maps as they pass by, with tracks, for a model that has none.

    A point's track names the image whose pixel it is and the sources that confirm it. There are at
    most 200 points per image, evenly over its pixels; which ones depends on the map alone.
    """

    def __init__(self) -> None:
        self._xyz: list[np.ndarray] = []
        self._views: list[tuple[str, ...]] = []

    def add(
        self,
        camera: Camera,
        depth: Float32[np.ndarray, "H W"],
        names: tuple[str, ...],
        agreeing: UInt8[np.ndarray, "H W"],
    ) -> None:
        """Take points of one map, from pixels confirmed by at least one source.

        Args:
            camera: In pixels of the map.
            depth: Planar; NaN where unknown.
            names: The image's name, and those of its sources.
            agreeing: Bit k is set where source k confirms the pixel.
        """
        rows, columns = np.nonzero(np.isfinite(depth) & (agreeing > 0))
        chosen = np.linspace(0, len(rows) - 1, min(_PER_MAP, len(rows))).astype(np.intp)
        rows, columns = rows[chosen], columns[chosen]
        uv = np.stack([columns, rows], axis=1) + 0.5
        self._xyz.append(camera.unproject(uv, depth[rows, columns]))
        for bits in agreeing[rows, columns]:
            confirming = (name for k, name in enumerate(names[1:]) if bits >> k & 1)
            self._views.append((names[0], *confirming))

    def model(self, images: Sequence[Image]) -> tuple[PointCloud, Renumbered]:
        """The points, and the images with features where they see them."""
        xyz = np.concatenate([np.empty((0, 3)), *self._xyz])
        idx_of = {image.name: idx for idx, image in enumerate(images)}
        lengths = np.array([len(views) for views in self._views], np.int64)
        image_idx = np.array([idx_of[n] for views in self._views for n in views], np.int64)
        point_idx = np.repeat(np.arange(len(xyz)), lengths)
        # The place of each track element among the features of its image.
        order = np.argsort(image_idx, kind="stable")
        counts = np.bincount(image_idx, minlength=len(images))
        places = np.empty(len(image_idx), np.uint32)
        places[order] = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
        tracks = Tracks(
            point_ids=np.arange(1, len(xyz) + 1),
            xyz=xyz,
            errors=np.full(len(xyz), _UNKNOWN_ERROR),
            offsets=np.concatenate([[0], np.cumsum(lengths)]),
            image_ids=np.array([i.image_id for i in images], np.uint32)[image_idx],
            point2d_idx=places,
        )
        featured = []
        for idx, image in enumerate(images):
            seen = point_idx[image_idx == idx]
            # A wrong confirmation may lie behind the camera.
            uv = np.nan_to_num(image.camera.project(xyz[seen])[0])
            featured.append(replace(image, observations=Observations(uv, seen + 1)))
        cloud = PointCloud(xyz.astype(np.float32), np.full(xyz.shape, _GREY, np.uint8))
        return cloud, Renumbered(tracks, tuple(featured), 0)


@dataclass(frozen=True)
class SparseModel:
    """Cameras and images of a workspace.

    Args:
        scene: Where they come from.
        cameras: One PINHOLE record for each camera and size of photograph.
        images: Ascending by id; features in the photographs' pixels.
    """

    scene: Scene
    cameras: tuple[Intrinsics, ...]
    images: tuple[Image, ...]

    @property
    def by_name(self) -> dict[str, Image]:
        """The images by their names."""
        return {image.name: image for image in self.images}

    @property
    def image_idxs(self) -> dict[str, int]:
        """COLMAP's index of each image, by its name."""
        return {image.name: idx for idx, image in enumerate(self.images)}

    def write(self, folder: Path, overlap: OverlapPoints) -> None:
        """Write ``cameras.bin``, ``images.bin`` and ``points3D.bin``.

        Args:
            folder: Made here.
            overlap: Points of the maps, for a scene without tracks.

        Raises:
            OutputError: A value does not fit its field.
            OSError: A file cannot be written.
        """
        # The finite, distinct points with tracks; added points have none.
        points = self.scene.points.select(slice(0, len(self.scene.tracks or ())))
        originals = clean_scene(replace(self.scene, points=points, images=self.images))
        points, tracked = originals.points, renumber(originals)
        if tracked.tracks is None or not len(tracked.tracks.image_ids):
            points, tracked = overlap.model(self.images)
        folder.mkdir()
        colmap_binary.write_cameras(folder / "cameras.bin", self.cameras)
        colmap_binary.write_images(folder / "images.bin", tracked.images)
        colmap_binary.write_points3d(folder / "points3D.bin", points, tracked.tracks)


def photograph_model(scene: Scene, sizes: Mapping[str, Size]) -> SparseModel:
    """The cameras and images of a scene, in pixels of the photographs as they are on disk.

    A camera record may be larger than its photographs (a folder of reduced copies); COLMAP samples
    colours at the record's pixels, so the two must agree.

    Args:
        scene: The scene; a camera with distortion becomes the pinhole camera of its undistorted
            photographs.
        sizes: Width and height of each photograph, by name.
    """
    cameras: dict[tuple[int, Size], Intrinsics] = {}
    images = []
    for image in sorted(scene.images, key=lambda image: image.image_id):
        lens, size = image.intrinsics, sizes[image.name]
        (fx, _, cx), (_, fy, cy), _ = scaled_K(image.camera, *size).tolist()
        pinhole = Intrinsics(len(cameras) + 1, "PINHOLE", *size, (fx, fy, cx, cy))
        record = cameras.setdefault((lens.camera_id, size), pinhole)
        seen = image.observations
        if seen is not None:
            uv = _straightened(lens, seen.xy) if lens.has_distortion else seen.xy
            scale = np.array([record.width / lens.width, record.height / lens.height])
            seen = Observations(uv * scale, seen.point_ids)
        images.append(replace(image, intrinsics=record, observations=seen))
    return SparseModel(scene, tuple(cameras.values()), tuple(images))


def _straightened(lens: Intrinsics, uv: Float64[np.ndarray, "M 2"]) -> Float64[np.ndarray, "M 2"]:
    """The features of a lens in the undistorted photograph.

    A feature that no ray of the lens reaches stays where it is.
    """
    straight = rays_through(lens, uv) * lens.K[[0, 1], [0, 1]] + lens.K[:2, 2]
    return np.where(np.isnan(straight), uv, straight)
