"""What a browser shows: pictures drawn here, and the points and cameras that it draws itself.

Notation: an *entry* is one of the things the user opened; the *canvas* is the browser's window as a
camera of the scene's world; *at* is the image whose camera the canvas stands at, or None; the
*stage* is the viewer's world (``stage_frame``), so that a browser's single precision suffices.
Promise: pictures are drawn one at a time, however many browsers are connected, because PyTorch's
and Numba's threads are shared; each browser gets its own points and cameras.
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
from splatseed.photos.view import View, poses_of
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene
from splatseed.seeding.coverage import covered_cells
from splatseed.splat.gaussians import Gaussians, TrainingFrame
from splatseed.splat.metrics import flip_map
from splatseed.splat.rendering import ModelRenderer, as_bytes, error_picture
from splatseed.viewer.clouds import cell_picture
from splatseed.viewer.models import Shown, pinhole_view
from splatseed.viewer.page import BLANK, depth_picture, photograph_at
from splatseed.viewer.points import origin_colors, render_points

Picture = UInt8[np.ndarray, "H W 3"]
Drawn = tuple[Picture | None, str]
"""A picture, or None and the reason why there is none."""
MOST_MOVING = 250_000
"""Gaussians rendered while a camera moves, on the CPU: projecting a million takes longer there than
all pixels. A GPU, which projects millions in milliseconds, renders all."""
CELL = 8  # side in pixels of the cells that are tested for seeds
PHOTOGRAPH_SIDE, CELLS_SIDE, ERROR_SIDE = 1600, 800, 640  # FLIP takes 1.6 s a megapixel on a core
AT_A_CAMERA = {"photograph", "error", "depth map", "uncovered cells"}
GO = "Click a camera to stand where a photograph was taken."
MOST_CAMERAS = 400  # that are drawn
FRUSTUM, LEAST_FRUSTUM, MOST_FRUSTUM = 0.5, 0.008, 0.05
"""Size of a camera relative to the distance to the next one, and its bounds on the stage."""
POINT_PIXELS = 1.4
"""Diameter of a point in pixels, as the first camera sees it in a picture 1000 pixels high."""
FARTHER, CLOSER = 10.0, 3.0
"""Points are sized for at most this many near depths, and cameras drawn for at most this many."""
TEST_COLOR, TRAIN_COLOR = (213, 94, 0), (0, 114, 178)
_DRAWING = threading.Lock()

# The canvas as a camera ---------------------------------------------------------------------------


def canvas_view(
    wxyz: Float[np.ndarray, " 4"],
    position: Float[np.ndarray, " 3"],
    fov: float,
    size: tuple[int, int],
    frame: TrainingFrame,
) -> View:
    """A browser's camera in the scene's world: its pose is on the stage, its fov vertical."""
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = rotation_from_quat(np.asarray(wxyz, np.float64)).T
    center = np.asarray(position, np.float64) / frame.scale + frame.origin
    cam_from_world[:3, 3] = -cam_from_world[:3, :3] @ center
    return pinhole_view(size, fov, cam_from_world)


def stage_pose(
    camera: Camera, frame: TrainingFrame
) -> tuple[Float64[np.ndarray, " 4"], Float64[np.ndarray, " 3"]]:
    """A camera's pose on the stage: rotation stage_from_cam as wxyz, and centre."""
    center = (camera.center - frame.origin) * frame.scale
    return quat_from_rotation(camera.world_from_cam[:3, :3]), center


def fitted_fov(camera: Camera, aspect: float) -> float:
    """The vertical field of view, radians, at which a canvas shows all that a camera saw."""
    by_height = camera.height / camera.K[1, 1]
    by_width = camera.width / camera.K[0, 0] / aspect
    return float(2 * np.arctan(max(by_height, by_width) / 2))


def laid_onto(
    canvas: View, picture: UInt8[np.ndarray, "h w 3"], camera: Camera, *, smooth: bool = True
) -> UInt8[np.ndarray, "H W 3"]:
    """A camera's picture, of any size, on a canvas with the same pose; black outside it."""
    height, width = picture.shape[:2]
    K = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
    picture_from_canvas = K @ np.linalg.inv(canvas.K)
    how = PillowImage.Resampling.BILINEAR if smooth else PillowImage.Resampling.NEAREST
    size, rows = (canvas.width, canvas.height), tuple(picture_from_canvas[:2].ravel().tolist())
    affine = PillowImage.Transform.AFFINE
    return np.asarray(PillowImage.fromarray(picture).transform(size, affine, rows, how))


# Pictures -----------------------------------------------------------------------------------------


class Entry:
    """Something the user opened, and the pictures that can be made of it on its stage."""

    def __init__(
        self, shown: Shown, frame: TrainingFrame, device: torch.device | None = None
    ) -> None:
        self.shown, self.name, self.frame, self._device = shown, shown.name, frame, device
        scene, painters = shown.scene, dict[str, Callable[[View, Any], Picture | str]]()
        if self.has_model:
            painters["Gaussians"] = lambda canvas, _: as_bytes(self.renderer.color(canvas))
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
            painters["origins"] = lambda canvas, _: render_points(colored, canvas.camera)
            if scene.images:
                painters["uncovered cells"] = self._uncovered
        self._painters = painters

    @cached_property
    def renderer(self) -> ModelRenderer:
        """The renderer of the whole model."""
        return ModelRenderer(self.shown.model, self.frame, self._device)

    @cached_property
    def quick_renderer(self) -> ModelRenderer:
        """A renderer for moving cameras, of the most visible Gaussians where all would be slow."""
        gaussians, on_gpu = self.shown.gaussians, getattr(self._device, "type", "cpu") == "cuda"
        if gaussians is None or on_gpu or len(gaussians) <= MOST_MOVING:
            return self.renderer
        return ModelRenderer(_most_seen(gaussians, MOST_MOVING), self.frame, self._device)

    @property
    def has_model(self) -> bool:
        """Whether there are Gaussians to render."""
        return self.shown.gaussians is not None

    @property
    def kinds(self) -> tuple[str, ...]:
        """The pictures that can be asked for."""
        return tuple(self._painters)

    def draw(self, kind: str, canvas: View, at: Image | None, *, quick: bool = False) -> Drawn:
        """A picture as large as the canvas; a quick one may skip the least visible Gaussians."""
        if at is None and kind in AT_A_CAMERA:
            return None, GO
        with _DRAWING:
            try:
                if quick and kind == "Gaussians":
                    return as_bytes(self.quick_renderer.color(canvas)), ""
                drawn = self._painters[kind](canvas, at)
            except SplatseedError as error:
                return None, str(error)
        return (None, drawn) if isinstance(drawn, str) else (drawn, "")

    def warm_up(self) -> None:
        """Compile the kernels that renders need, so that no browser waits for them."""
        if self.has_model:
            for quick in (True, False):
                self.draw("Gaussians", pinhole_view((32, 24), 0.7, np.eye(4)), None, quick=quick)

    def _photograph(self, canvas: View, at: Image) -> Picture | str:
        photograph = _photograph_of(self._scene, at, PHOTOGRAPH_SIDE)
        if photograph is None:
            return f"The photograph {at.name} cannot be read."
        return laid_onto(canvas, photograph, at.camera)

    def _error(self, canvas: View, at: Image) -> Picture | str:
        side = min(ERROR_SIDE, max(canvas.width, canvas.height))
        view, photograph = _sized(at, side), _photograph_of(self._scene, at, side)
        if photograph is None:
            return f"The photograph {at.name} cannot be read."
        images = torch.from_numpy(self.renderer.color(view)), torch.from_numpy(photograph) / 255
        return laid_onto(canvas, error_picture(flip_map(*images)), at.camera)

    def _depth_map(self, canvas: View, at: Image) -> Picture | str:
        maps = self._scene.depths
        if maps is None or at.name not in maps:
            return f"{at.name} has no depth map."
        picture = depth_picture(maps.read(at.name).values)
        return laid_onto(canvas, picture, at.camera, smooth=False)

    def _uncovered(self, canvas: View, at: Image) -> Picture | str:
        view, photograph = _sized(at, CELLS_SIDE), _photograph_of(self._scene, at, CELLS_SIDE)
        if photograph is None:
            photograph = np.full((view.height, view.width, 3), BLANK, np.uint8)
        (covered,) = covered_cells([view], self._scene.points.xyz, CELL)
        return laid_onto(canvas, cell_picture(photograph, covered, CELL), at.camera)

    @property
    def _scene(self) -> Scene:
        assert self.shown.scene is not None  # noqa: S101  (kinds says so)
        return self.shown.scene


def _most_seen(gaussians: Gaussians, count: int) -> Gaussians:
    """The Gaussians with the largest opacity times area, in their original order."""
    wide = np.sort(gaussians.scales.astype(np.float64), axis=1)[:, 1:].sum(axis=1)
    weight = wide - np.logaddexp(0, -gaussians.opacities.astype(np.float64))
    keep = np.sort(np.argpartition(-weight, count)[:count])
    return gaussians.select(keep)


def _sized(image: Image, side: int) -> View:
    """An image's view, its longer side at most ``side`` pixels."""
    (view,) = poses_of([image], max(1, -(-max(image.camera.width, image.camera.height) // side)))
    return view


@lru_cache(maxsize=8)
def _photograph_of(scene: Scene, image: Image, side: int) -> UInt8[np.ndarray, "h w 3"] | None:
    view = _sized(image, side)
    return photograph_at(scene, image, (view.width, view.height))


# What the browser draws ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class StageCloud:
    """Points of one origin on the stage: some of ``count``, their colours and the origin's."""

    name: str
    xyz: Float32[np.ndarray, "N 3"]
    rgb: UInt8[np.ndarray, "N 3"]
    color: tuple[int, int, int]
    count: int


def clouds_of(points: PointCloud, frame: TrainingFrame, most: int) -> list[StageCloud]:
    """A cloud's finite points by origin, moved onto the stage and thinned evenly to ``most``."""
    every = max(1, -(-len(points) // most))
    finite = points.select(points.finite)
    codes, counts = np.unique(finite.source, return_counts=True)
    clouds = []
    for code, count in zip(codes.tolist(), counts.tolist(), strict=True):
        part = finite.select(np.flatnonzero(finite.source == code)[::every])
        color = tuple(origin_colors(np.array([code], np.uint8))[0].tolist())
        xyz = frame.points_from_world(part.xyz)
        clouds.append(StageCloud(source_name(code), xyz, part.rgb, color, count))
    return clouds


def point_size(
    clouds: Sequence[StageCloud], images: Sequence[Image], frame: TrainingFrame
) -> float:
    """The diameter on the stage at which the first camera sees a point a few pixels wide."""
    xyz = np.concatenate([cloud.xyz[:: max(1, len(cloud.xyz) // 5000)] for cloud in clouds])
    eye = stage_pose(images[0].camera, frame)[1] if images else 3 * np.ones(3)
    distance = float(np.median(np.linalg.norm(xyz - eye, axis=1)))
    # Most of a long walk is far away, and all of it from a camera that strays.
    return min(distance, FARTHER * frame.near_depth) * POINT_PIXELS / 1000


def add_cameras(
    gui_scene: Any, shown: Shown, frame: TrainingFrame, fly: Callable[[Image], None]
) -> list[tuple[Image, Any]]:
    """Add a frustum for each image's camera, test views in another colour; a click flies there.

    Of more than ``MOST_CAMERAS``, every n-th training and every n-th test view.
    """
    assert shown.scene is not None  # noqa: S101  (see above)
    tested = {image.name for image in shown.scene.split(shown.test_every)[1]}
    every = max(1, -(-len(shown.scene.images) // MOST_CAMERAS))
    parts = [
        [i for i in shown.scene.images if (i.name in tested) == test] for test in (False, True)
    ]
    images = [image for part in parts for image in part[::every]]
    size, poses = MOST_FRUSTUM, [stage_pose(image.camera, frame) for image in images]
    if len(images) > 1:  # the largest at which neighbouring cameras do not overlap
        centers = np.array([center for _, center in poses])
        gaps = np.linalg.norm(centers[:, None] - centers[None], axis=2)
        np.fill_diagonal(gaps, np.inf)
        size = float(np.clip(FRUSTUM * np.median(gaps.min(axis=1)), LEAST_FRUSTUM, MOST_FRUSTUM))
    size = min(size, MOST_FRUSTUM * CLOSER * frame.near_depth)
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
