"""Pictures drawn for browsers, and the points and cameras that browsers draw themselves.

Notation: an *entry* is an item that the user opened, with its pictures; the *canvas* is the
browser's window as a camera in the scene's world; *at* is the image whose camera the canvas is at,
or None; the *viewer frame* is as in ``models``. Promise: pictures are drawn one at a time, whatever
the number of browsers, because PyTorch's and Numba's threads are shared; each browser gets its own
points and cameras.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, UInt8
from PIL import Image as PillowImage

from splatseed.camera import Camera, quat_from_rotation, rotation_from_quat
from splatseed.errors import SplatseedError
from splatseed.methods import source_name
from splatseed.photos.undistortion import undistort
from splatseed.photos.view import View, camera_views
from splatseed.pointcloud import PointCloud
from splatseed.projection import scaled
from splatseed.scene import Image, Scene
from splatseed.seeding.cover import covered_cells
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.metrics import flip_map
from splatseed.splat.pictures import flip_heatmap, to_uint8
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.training_frame import TrainingFrame
from splatseed.viewer.clouds import cell_picture
from splatseed.viewer.models import ViewerItem, pinhole_view
from splatseed.viewer.page import BLANK, depth_picture, photograph_at
from splatseed.viewer.points import origin_colors, points_over, render_points

Picture = UInt8[np.ndarray, "H W 3"]
Drawn = tuple[Picture | None, str]
"""A picture and an empty text, or None and the reason."""
MAX_MOVING = 250_000
"""Gaussians rendered while a camera moves, on the CPU: projecting a million takes longer there than
shading all pixels. A GPU, which projects millions in milliseconds, renders all."""
CELL = 8  # side in pixels of the cells that are tested for seeds
PHOTOGRAPH_SIDE, CELLS_SIDE, ERROR_SIDE = 1600, 800, 640  # FLIP takes 1.6 s a megapixel on a core
NEEDS_CAMERA = {"photograph", "error", "depth map", "uncovered cells"}
CLICK_A_CAMERA = "Click a camera to move to where a photograph was taken."
MAX_CAMERAS = 400  # drawn in the browser
TEST_COLOR, TRAIN_COLOR = (213, 94, 0), (0, 114, 178)


@dataclass(frozen=True)
class _Sizes:
    frustum: float = 0.5  # relative to the distance to the nearest other camera
    min_frustum: float = 0.008
    max_frustum: float = 0.05
    max_frustum_depths: float = 3.0  # near depths at which the largest frustum is still drawn
    point_pixels: float = 1.4  # diameter seen by the first camera, in a picture 1000 pixels high
    max_point_depths: float = 10.0  # near depths that points are sized for at most


SIZES = _Sizes()
_DRAWING = threading.Lock()

# The canvas as a camera ---------------------------------------------------------------------------


def canvas_view(
    wxyz: Float[np.ndarray, " 4"],
    position: Float[np.ndarray, " 3"],
    fov: float,
    size: tuple[int, int],
    frame: TrainingFrame,
) -> View:
    """Convert a browser's camera (pose in the viewer frame, vertical fov) to the scene's world."""
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = rotation_from_quat(np.asarray(wxyz, np.float64)).T
    center = np.asarray(position, np.float64) / frame.scale + frame.origin
    cam_from_world[:3, 3] = -cam_from_world[:3, :3] @ center
    return pinhole_view(size, fov, cam_from_world)


def viewer_pose(
    camera: Camera, frame: TrainingFrame
) -> tuple[Float64[np.ndarray, " 4"], Float64[np.ndarray, " 3"]]:
    """Pose of a camera in the viewer frame: rotation viewer_from_cam as wxyz, and centre."""
    center = (camera.center - frame.origin) * frame.scale
    return quat_from_rotation(camera.world_from_cam[:3, :3]), center


def fitted_fov(camera: Camera, aspect: float) -> float:
    """Vertical field of view, radians, at which a canvas contains a camera's image."""
    by_height = camera.height / camera.K[1, 1]
    by_width = camera.width / camera.K[0, 0] / aspect
    return float(2 * np.arctan(max(by_height, by_width) / 2))


def warp_to_canvas(
    canvas: View, picture: UInt8[np.ndarray, "h w 3"], camera: Camera, *, smooth: bool = True
) -> UInt8[np.ndarray, "H W 3"]:
    """Warp a camera's picture of any size to a canvas with the same pose; black outside."""
    height, width = picture.shape[:2]
    K = scaled(camera.K, width / camera.width, height / camera.height)
    picture_from_canvas = K @ np.linalg.inv(canvas.K)
    resample = PillowImage.Resampling.BILINEAR if smooth else PillowImage.Resampling.NEAREST
    size, rows = (canvas.width, canvas.height), tuple(picture_from_canvas[:2].ravel().tolist())
    affine = PillowImage.Transform.AFFINE
    return np.asarray(PillowImage.fromarray(picture).transform(size, affine, rows, resample))


# Pictures -----------------------------------------------------------------------------------------


class Entry:
    """An item and the pictures that can be drawn of it."""

    def __init__(
        self, item: ViewerItem, frame: TrainingFrame, device: torch.device | None = None
    ) -> None:
        self.item, self.name, self.frame, self._device = item, item.name, frame, device
        scene, painters = item.scene, dict[str, Callable[[View, Any], Picture | str]]()
        if self.has_model:
            painters["Gaussians"] = lambda canvas, _: to_uint8(self.renderer.color(canvas))
            painters["depth"] = lambda canvas, _: depth_picture(self.renderer.depth(canvas))
        if scene is not None and scene.has_photographs:
            painters["photograph"] = self._photograph
            if self.has_model:
                painters["error"] = self._error
        if scene is not None and scene.depths is not None:
            painters["depth map"] = self._depth_map
        if scene is not None and len(scene.points):
            points = scene.points
            colored = points.replace(rgb=origin_colors(points.source))
            painters["points"] = lambda canvas, _: render_points(points, canvas.camera)
            painters["origins"] = lambda canvas, _: points_over(colored, canvas.camera)
            if scene.images:
                painters["uncovered cells"] = self._uncovered
        self._painters = painters

    @cached_property
    def renderer(self) -> ModelRenderer:
        """Renderer of all Gaussians."""
        return self._renderer_of(self.item.model)

    @cached_property
    def fast_renderer(self) -> ModelRenderer:
        """Renderer for moving cameras, of the most visible Gaussians if all would be slow."""
        gaussians, on_gpu = self.item.gaussians, getattr(self._device, "type", "cpu") == "cuda"
        if gaussians is None or on_gpu or len(gaussians) <= MAX_MOVING:
            return self.renderer
        return self._renderer_of(_most_visible(gaussians, MAX_MOVING))

    def _renderer_of(self, gaussians: Gaussians) -> ModelRenderer:
        return ModelRenderer(gaussians, self.frame, self._device, self.item.background)

    @property
    def has_model(self) -> bool:
        """Whether there are Gaussians to render."""
        return self.item.gaussians is not None

    @property
    def kinds(self) -> tuple[str, ...]:
        """The pictures that can be drawn."""
        return tuple(self._painters)

    def draw(self, kind: str, canvas: View, at: Image | None, *, fast: bool = False) -> Drawn:
        """Draw a picture of the canvas's size; ``fast`` may skip the least visible Gaussians."""
        if at is None and kind in NEEDS_CAMERA:
            return None, CLICK_A_CAMERA
        with _DRAWING:
            try:
                if fast and kind == "Gaussians":
                    return to_uint8(self.fast_renderer.color(canvas)), ""
                drawn = self._painters[kind](canvas, at)
            except SplatseedError as error:
                return None, str(error)
        return (None, drawn) if isinstance(drawn, str) else (drawn, "")

    def warm_up(self) -> None:
        """Compile the kernels that rendering needs, so that no browser waits for them."""
        if self.has_model:
            for fast in (True, False):
                self.draw("Gaussians", pinhole_view((32, 24), 0.7, np.eye(4)), None, fast=fast)

    def _photograph(self, canvas: View, at: Image) -> Picture | str:
        photograph = _photograph_of(at, PHOTOGRAPH_SIDE)
        if photograph is None:
            return f"The photograph {at.name} cannot be read."
        return warp_to_canvas(canvas, photograph, at.camera)

    def _error(self, canvas: View, at: Image) -> Picture | str:
        side = min(ERROR_SIDE, max(canvas.width, canvas.height))
        view, photograph = _view_within(at, side), _photograph_of(at, side)
        if photograph is None:
            return f"The photograph {at.name} cannot be read."
        images = torch.from_numpy(self.renderer.color(view)), torch.from_numpy(photograph) / 255
        return warp_to_canvas(canvas, flip_heatmap(flip_map(*images)), at.camera)

    def _depth_map(self, canvas: View, at: Image) -> Picture | str:
        maps = self._scene.depths
        if maps is None or at.name not in maps:
            return f"{at.name} has no depth map."
        picture = depth_picture(maps.read(at.name).values)
        return warp_to_canvas(canvas, picture, at.camera, smooth=False)

    def _uncovered(self, canvas: View, at: Image) -> Picture | str:
        view, photograph = _view_within(at, CELLS_SIDE), _photograph_of(at, CELLS_SIDE)
        if photograph is None:
            photograph = np.full((view.height, view.width, 3), BLANK, np.uint8)
        (covered,) = covered_cells([view], self._scene.points.xyz, CELL)
        return warp_to_canvas(canvas, cell_picture(photograph, covered, CELL), at.camera)

    @property
    def _scene(self) -> Scene:
        assert self.item.scene is not None  # noqa: S101  (true of the kinds that use it)
        return self.item.scene


def _most_visible(gaussians: Gaussians, count: int) -> Gaussians:
    """Select the Gaussians with the largest opacity times area, in their original order."""
    extent = np.sort(gaussians.scales.astype(np.float64), axis=1)[:, 1:].sum(axis=1)
    weight = extent - np.logaddexp(0, -gaussians.opacities.astype(np.float64))
    keep = np.sort(np.argpartition(-weight, count)[:count])
    return gaussians.select(keep)


def _view_within(image: Image, side: int) -> View:
    """View of an image downsampled by a whole factor to at most ``side`` pixels."""
    (view,) = camera_views(
        [image], max(1, -(-max(image.camera.width, image.camera.height) // side))
    )
    return view


@lru_cache(maxsize=8)
def _photograph_of(image: Image, side: int) -> UInt8[np.ndarray, "h w 3"] | None:
    """Read a photograph without its lens distortion, as models are rendered."""
    view = _view_within(image, side)
    photograph = photograph_at(image, (view.width, view.height))
    if photograph is None or not image.intrinsics.has_distortion:
        return photograph
    return undistort(photograph, image.intrinsics, view.K)[0]


# What the browser draws ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ViewerCloud:
    """A sample of the ``count`` points of an origin, in the viewer frame."""

    name: str
    xyz: Float32[np.ndarray, "N 3"]
    rgb: UInt8[np.ndarray, "N 3"]
    color: tuple[int, int, int]
    count: int


def clouds_by_origin(
    points: PointCloud, frame: TrainingFrame, limit: int, other: str = "other"
) -> list[ViewerCloud]:
    """Split the finite points by origin, thinned evenly to ``limit``, in the viewer frame.

    ``other`` is the name of a third party's method.
    """
    every = max(1, -(-len(points) // limit))
    finite = points.select(points.finite)
    codes, counts = np.unique(finite.source, return_counts=True)
    clouds = []
    for code, count in zip(codes.tolist(), counts.tolist(), strict=True):
        part = finite.select(np.flatnonzero(finite.source == code)[::every])
        color = tuple(origin_colors(np.array([code], np.uint8))[0].tolist())
        xyz = frame.points_from_world(part.xyz)
        clouds.append(ViewerCloud(source_name(code, other), xyz, part.rgb, color, count))
    return clouds


def point_size(
    clouds: Sequence[ViewerCloud], images: Sequence[Image], frame: TrainingFrame
) -> float:
    """Diameter in the viewer frame at which the first camera sees points a few pixels wide."""
    xyz = np.concatenate([cloud.xyz[:: max(1, len(cloud.xyz) // 5000)] for cloud in clouds])
    eye = viewer_pose(images[0].camera, frame)[1] if images else 3 * np.ones(3)
    distance = float(np.median(np.linalg.norm(xyz - eye, axis=1)))
    # On a long walk most points are far away, and from a stray camera all are.
    distance = min(distance, SIZES.max_point_depths * frame.near_depth)
    return distance * SIZES.point_pixels / 1000


def add_cameras(
    gui_scene: Any, item: ViewerItem, frame: TrainingFrame, fly: Callable[[Image], None]
) -> list[tuple[Image, Any]]:
    """Add a frustum per camera, test views in another colour; a click on it calls ``fly``.

    Of more than ``MAX_CAMERAS``, every n-th training and test view is added.
    """
    assert item.scene is not None  # noqa: S101  (callers check)
    tested = {image.name for image in item.scene.split(item.test_every)[1]}
    every = max(1, -(-len(item.scene.images) // MAX_CAMERAS))
    parts = [[i for i in item.scene.images if (i.name in tested) == test] for test in (False, True)]
    images = [image for part in parts for image in part[::every]]
    size, poses = SIZES.max_frustum, [viewer_pose(image.camera, frame) for image in images]
    if len(images) > 1:  # the largest at which neighbouring cameras do not overlap
        centers = np.array([center for _, center in poses])
        gaps = np.linalg.norm(centers[:, None] - centers[None], axis=2)
        np.fill_diagonal(gaps, np.inf)
        size = SIZES.frustum * float(np.median(gaps.min(axis=1)))
        size = float(np.clip(size, SIZES.min_frustum, SIZES.max_frustum))
    size = min(size, SIZES.max_frustum * SIZES.max_frustum_depths * frame.near_depth)
    handles = []
    for i, (image, (wxyz, position)) in enumerate(zip(images, poses, strict=True)):
        camera = image.camera
        fov = 2 * float(np.arctan(camera.height / 2 / camera.K[1, 1]))
        color = TEST_COLOR if image.name in tested else TRAIN_COLOR
        handle = gui_scene.add_camera_frustum(
            f"/cameras/{i}", fov, camera.width / camera.height, scale=size, thickness=1.5,
            thickness_units="screen", color=color, wxyz=wxyz, position=position,
        )  # fmt: skip
        handle.on_click(lambda _, image=image: fly(image))
        handles.append((image, handle))
    return handles
