"""Posed pinhole cameras, and COLMAP's camera records.

``cam_from_world`` [4, 4] maps homogeneous world points to OpenCV camera axes (x right, y down, z
forward); ``K`` [3, 3] maps camera rays to pixels. The centre of the top-left pixel is (0.5, 0.5).
Quaternions are wxyz. All numbers are float64. ``Intrinsics.params`` hold distortion,
which ``Camera`` ignores.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from splatseed.errors import SceneFormatError
from splatseed.frozen import read_only
from splatseed.projection import camera_centers, normalized, project


class CameraModel(NamedTuple):
    """One of COLMAP's camera models."""

    model_id: int
    name: str
    num_params: int
    num_focal: int
    """1 if fx = fy is stored once, 2 if they are separate; the principal point follows."""


CAMERA_MODELS: dict[str, CameraModel] = {
    model.name: model
    for model in (
        CameraModel(0, "SIMPLE_PINHOLE", 3, 1),
        CameraModel(1, "PINHOLE", 4, 2),
        CameraModel(2, "SIMPLE_RADIAL", 4, 1),
        CameraModel(3, "RADIAL", 5, 1),
        CameraModel(4, "OPENCV", 8, 2),
        CameraModel(5, "OPENCV_FISHEYE", 8, 2),
        CameraModel(6, "FULL_OPENCV", 12, 2),
        CameraModel(7, "FOV", 5, 2),
        CameraModel(8, "SIMPLE_RADIAL_FISHEYE", 4, 1),
        CameraModel(9, "RADIAL_FISHEYE", 5, 1),
        CameraModel(10, "THIN_PRISM_FISHEYE", 12, 2),
        CameraModel(11, "RAD_TAN_THIN_PRISM_FISHEYE", 16, 2),
        CameraModel(12, "SIMPLE_DIVISION", 4, 1),
        CameraModel(13, "DIVISION", 5, 2),
        CameraModel(14, "SIMPLE_FISHEYE", 3, 1),
        CameraModel(15, "FISHEYE", 4, 2),
        CameraModel(16, "EUCM", 6, 2),
    )
}
"""COLMAP 4.2's camera models by name, without panoramas."""
PANORAMA = CameraModel(17, "EQUIRECTANGULAR", 2, 0)
"""COLMAP's model of full panoramas; its parameters are their width and height. No pinhole camera
can show them: ``load_scene`` refuses them unless they are to be cut (``sfm.panoramas``)."""
MODELS = {**CAMERA_MODELS, PANORAMA.name: PANORAMA}
"""All of COLMAP 4.2's camera models."""
FACE_HALF_VIEW = 50.0
"""Degrees between the axis of a photograph that is cut from a panorama and the middle of its sides:
45 and a margin that the next one shows, too."""
_FACE_TOLERANCE = 0.02
"""Of their width: it is rounded, and refined focal lengths differ a little."""

_TWO_FOCAL = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "SIMPLE_DIVISION": "DIVISION",
    "SIMPLE_FISHEYE": "FISHEYE",
}
"""For each model with one focal length, a model with two that starts with the same coefficients and
is equal if its further coefficients are 0."""


@dataclass(frozen=True)
class Intrinsics:
    """A COLMAP camera record: model, size and parameters, without a pose.

    Raises:
        SceneFormatError: The model is unknown, or the number of parameters is not the model's.
    """

    camera_id: int
    model: str  # a key of ``MODELS``
    width: int  # pixels
    height: int
    params: tuple[float, ...]  # in COLMAP's order; pixels for focal lengths and centre

    def __post_init__(self) -> None:
        model = MODELS.get(self.model)
        if model is None:
            raise SceneFormatError(
                f"camera {self.camera_id} to have one of COLMAP's models ({', '.join(MODELS)})",
                found=f"{self.model!r}",
                fix="Undistort the scene to PINHOLE (colmap image_undistorter) and try again.",
            )
        if len(self.params) != model.num_params:
            raise SceneFormatError(
                f"camera {self.camera_id} ({self.model}) to have {model.num_params} parameters",
                found=f"{len(self.params)}",
                fix="Write the model again with COLMAP.",
            )

    @property
    def is_pinhole(self) -> bool:
        """Whether the model has no distortion, as 3DGS trainers require."""
        return self.model in {"PINHOLE", "SIMPLE_PINHOLE"}

    @property
    def is_fisheye(self) -> bool:
        """Whether the image radius grows with the angle from the axis, not with its tangent."""
        return self.model.endswith("FISHEYE")

    @property
    def is_panorama(self) -> bool:
        """Whether it shows all directions, by longitude and latitude."""
        return self.model == PANORAMA.name

    @property
    def is_face(self) -> bool:
        """Whether it is as those that ``sfm`` and ``undistort`` cut from panoramas."""
        half = math.tan(math.radians(FACE_HALF_VIEW)) * self.K[0, 0]  # pixels
        return self.width == self.height and abs(2 * half / self.width - 1) < _FACE_TOLERANCE

    @property
    def has_distortion(self) -> bool:
        """Whether lines are curved: always for a fisheye or panorama, else by the coefficients."""
        terms = self.params[MODELS[self.model].num_focal + 2 :]
        if self.model == "EUCM":
            terms = terms[:1]  # without alpha, beta has no effect
        return self.is_fisheye or self.is_panorama or any(terms)

    @property
    def pinhole(self) -> Intrinsics:
        """The same camera as PINHOLE, without distortion."""
        (fx, _, cx), (_, fy, cy), _ = self.K.tolist()
        return replace(self, model="PINHOLE", params=(fx, fy, cx, cy))

    @property
    def K(self) -> Float64[np.ndarray, "3 3"]:  # noqa: N802  (the field's name)
        """The pinhole matrix in pixels, without distortion; NaN for a panorama, which has none."""
        if self.is_panorama:
            return np.full((3, 3), np.nan)
        num_focal = CAMERA_MODELS[self.model].num_focal
        fx, fy = self.params[0], self.params[num_focal - 1]
        cx, cy = self.params[num_focal : num_focal + 2]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def resized(self, width: int, height: int) -> Intrinsics:
        """Return the camera of a photograph resized to this size.

        Distortion acts on normalised coordinates, so only focal lengths and centre change. If the
        axes scale differently, by rounding or stretching, a model with two focal lengths replaces
        one with a single focal length.
        """
        if (width, height) == (self.width, self.height):
            return self
        x, y, name = width / self.width, height / self.height, self.model
        if self.is_panorama:
            params = (self.params[0] * x, self.params[1] * y)
            return replace(self, width=width, height=height, params=params)
        num_focal, focal = CAMERA_MODELS[name].num_focal, self.params[:1]
        terms = self.params[num_focal + 2 :]
        if num_focal == 2:
            focal = (self.params[0] * x, self.params[1] * y)
        elif width * self.height == height * self.width:
            focal = (self.params[0] * x,)
        else:
            name, focal = _TWO_FOCAL[name], (self.params[0] * x, self.params[0] * y)
            terms += (0.0,) * (CAMERA_MODELS[name].num_params - 4 - len(terms))
        cx, cy = self.params[num_focal : num_focal + 2]
        params = (*focal, cx * x, cy * y, *terms)
        return replace(self, model=name, width=width, height=height, params=params)


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with its pose.

    Example:
        >>> import numpy as np
        >>> K = np.array([[100.0, 0, 50], [0, 100.0, 40], [0, 0, 1]])
        >>> camera = Camera(K, 100, 80, np.eye(4))
        >>> uv, depth = camera.project(np.array([[0.0, 0.0, 2.0]]))
        >>> uv.tolist(), depth.tolist()
        ([[50.0, 40.0]], [2.0])
    """

    K: Float64[np.ndarray, "3 3"]  # in pixels
    width: int  # pixels
    height: int
    cam_from_world: Float64[np.ndarray, "4 4"]  # world to OpenCV camera axes

    def __post_init__(self) -> None:
        for name in ("K", "cam_from_world"):
            object.__setattr__(self, name, read_only(getattr(self, name), np.float64))

    @property
    def world_from_cam(self) -> Float64[np.ndarray, "4 4"]:
        """The inverse of ``cam_from_world``, by the rigid formula."""
        inverse = np.eye(4)
        inverse[:3, :3] = self.cam_from_world[:3, :3].T
        inverse[:3, 3] = self.center
        return inverse

    @property
    def center(self) -> Float64[np.ndarray, " 3"]:
        """The camera's position in the world."""
        return np.asarray(camera_centers([self.cam_from_world])[0])

    @property
    def pixels_from_world(self) -> Float64[np.ndarray, "3 4"]:
        """The matrix K cam_from_world, with which ``projection.project`` gives pixels."""
        return np.asarray(self.K @ self.cam_from_world[:3])

    def grid_shape(self, cell: float) -> tuple[int, int]:
        """Rows and columns of the cells, at most ``cell`` pixels wide, that divide the image.

        All cells are equal: a little smaller than ``cell`` where it does not divide the size.
        """
        return math.ceil(self.height / cell), math.ceil(self.width / cell)

    def cells_from_world(self, cell: float) -> Float64[np.ndarray, "3 4"]:
        """The matrix to cells: cell (i, j) spans rows i to i + 1 and columns j to j + 1."""
        rows, cols = self.grid_shape(cell)
        cells_from_pixels = np.diag([cols / self.width, rows / self.height, 1.0])
        return np.asarray(cells_from_pixels @ self.K @ self.cam_from_world[:3])

    def project(
        self, xyz: Float[np.ndarray, "N 3"]
    ) -> tuple[Float64[np.ndarray, "N 2"], Float64[np.ndarray, " N"]]:
        """Project world points; return pixel coordinates and planar z-depths.

        Pixel coordinates are NaN for depths of 0 or less.
        """
        column, row, depth = project(self.pixels_from_world, xyz)
        uv = np.stack([column, row], axis=1)
        uv[~(depth > 0)] = np.nan
        return uv, depth

    def rays(self, uv: Float[np.ndarray, "*B 2"]) -> Float64[np.ndarray, "*B 3"]:
        """Return world directions through pixel coordinates ``uv``, with unit z in camera axes."""
        x, y = np.moveaxis(normalized(self.K, uv), -1, 0)
        return np.stack([a * x + b * y + c for a, b, c in self.cam_from_world[:3, :3].T], axis=-1)

    def unproject(
        self, uv: Float[np.ndarray, "N 2"], depth: Float[np.ndarray, " N"]
    ) -> Float64[np.ndarray, "N 3"]:
        """Return the world points at pixel coordinates ``uv`` and planar z-depths ``depth``."""
        return np.asarray(self.center + np.asarray(depth, np.float64)[:, None] * self.rays(uv))


def same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes have one aspect ratio, within a pixel."""
    return abs(size[0] * other[1] - size[1] * other[0]) <= max(*size, *other)


def rotation_from_quat(quat: Float[np.ndarray, " 4"]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation matrix of a wxyz quaternion of any length."""
    w, x, y, z = np.asarray(quat, np.float64) / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quat_from_rotation(rotation: Float[np.ndarray, "3 3"]) -> Float64[np.ndarray, " 4"]:
    """Return the unit wxyz quaternion, w >= 0, of a rotation matrix."""
    m = np.asarray(rotation, np.float64)
    # The quaternion is the top eigenvector of a symmetric 4x4 form: no branch on the trace, and
    # the nearest rotation if the matrix is not quite orthonormal.
    form = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], 0, 0, 0],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], 0, 0],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    quat = np.linalg.eigh(form)[1][:, -1]  # eigh reads the lower triangle
    return np.asarray(-quat if quat[0] < 0 else quat)
