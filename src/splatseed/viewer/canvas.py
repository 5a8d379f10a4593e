"""The canvas of a browser as a camera of the scene's world, and photographs laid onto it.

Notation: the *stage* is the viewer's world: the scene's, moved and scaled into its training frame
so that a browser's single precision suffices. Poses follow OpenCV. A canvas pixel's centre is at
+0.5.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64, UInt8

from splatseed.camera import Camera, quat_from_rotation, rotation_from_quat
from splatseed.splat.gaussians import TrainingFrame
from splatseed.views.view import View

NO_PIXELS = np.empty((0, 0, 3), np.uint8)


def canvas_view(
    wxyz: Float[np.ndarray, " 4"],
    position: Float[np.ndarray, " 3"],
    fov: float,
    size: tuple[int, int],
    frame: TrainingFrame,
) -> View:
    """A browser's camera in the scene's world.

    Args:
        wxyz: Rotation stage_from_cam.
        position: The camera's centre on the stage.
        fov: Vertical field of view, radians.
        size: Width and height of the picture to draw.
        frame: From the scene's world to the stage.
    """
    width, height = size
    # fov is vertical: tan(fov / 2) = (height / 2) / focal
    focal = height / 2 / np.tan(fov / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = rotation_from_quat(np.asarray(wxyz, np.float64)).T
    center = np.asarray(position, np.float64) / frame.scale + frame.origin
    cam_from_world[:3, 3] = -cam_from_world[:3, :3] @ center
    return View("canvas", NO_PIXELS, K, width, height, cam_from_world)


def stage_pose(
    camera: Camera, frame: TrainingFrame
) -> tuple[Float64[np.ndarray, " 4"], Float64[np.ndarray, " 3"]]:
    """A camera's pose on the stage: rotation stage_from_cam as wxyz, and centre."""
    center = (camera.center - frame.origin) * frame.scale
    return quat_from_rotation(camera.world_from_cam[:3, :3]), center


def fitted_fov(camera: Camera, aspect: float) -> float:
    """The vertical field of view, radians, at which a canvas shows everything the camera saw.

    Args:
        camera: Its principal point is assumed to be central.
        aspect: Width of the canvas over its height.
    """
    by_height = camera.height / camera.K[1, 1]
    by_width = camera.width / camera.K[0, 0] / aspect
    return float(2 * np.arctan(max(by_height, by_width) / 2))


def laid_onto(
    canvas: View, picture: UInt8[np.ndarray, "h w 3"], camera: Camera, *, smooth: bool = True
) -> UInt8[np.ndarray, "H W 3"]:
    """A camera's picture as seen on a canvas with the same pose; black outside the picture.

    Args:
        canvas: The view to draw.
        picture: What the camera saw, at any size.
        camera: The intrinsics of the picture.
        smooth: Interpolate between pixels.
    """
    from PIL import Image  # noqa: PLC0415  (slow to import)

    height, width = picture.shape[:2]
    K = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
    picture_from_canvas = K @ np.linalg.inv(canvas.K)
    how = Image.Resampling.BILINEAR if smooth else Image.Resampling.NEAREST
    laid = Image.fromarray(picture).transform(
        (canvas.width, canvas.height),
        Image.Transform.AFFINE,
        tuple(picture_from_canvas[:2].reshape(-1).tolist()),
        how,
    )
    return np.asarray(laid)
