"""Planar depth of a map, in the pixels and units of a camera.

Notation: a ray has unit z in camera axes, so that its length is distance over planar depth.
Promise: a pixel's ray passes through its centre, at +0.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int, Int64

from splatseed.camera import Camera
from splatseed.depthmap import DepthMap
from splatseed.errors import SceneFormatError
from splatseed.kernels.jit import inline
from splatseed.scene import Image


def map_camera(depth: DepthMap, image: Image) -> Camera:
    """The camera of an image in the pixels of its map.

    Raises:
        SceneFormatError: The map and the image differ in aspect ratio.
    """
    try:
        return depth.camera(image.camera)
    except SceneFormatError as error:
        raise SceneFormatError(
            f"for {image.name} {error.expected}", found=error.found, fix=error.fix
        ) from None


def ray_length(
    camera: Camera, column: Int[np.ndarray, " ..."], row: Int[np.ndarray, " ..."]
) -> Float64[np.ndarray, " ..."]:
    """Distance over planar depth along the rays through pixel centres; the arguments broadcast."""
    x = (column + (0.5 - camera.K[0, 2])) / camera.K[0, 0]
    y = (row + (0.5 - camera.K[1, 2])) / camera.K[1, 1]
    return np.asarray(np.sqrt(x * x + y * y + 1.0))


@dataclass(frozen=True, eq=False)
class PlanarDepth:
    """A map whose planar depth is computed only where needed.

    Most maps need only one factor, and multiplying a whole map takes longer than everything done
    with the few pixels that are lifted.

    Args:
        values: float32 [H, W]; NaN, or not above 0, where depth is unknown.
        scale: Scene units per unit of ``values``.
        along_ray: Whether values are distances along the ray.
        camera: The image's camera in pixels of the map.
    """

    values: Float32[np.ndarray, "H W"]
    scale: float
    along_ray: bool
    camera: Camera

    @classmethod
    def of(
        cls, depth: DepthMap, camera: Camera, scale: float, shift: float, *, unit_ray: bool
    ) -> PlanarDepth:
        """A map with its alignment.

        Args:
            depth: The map.
            camera: The image's camera in pixels of the map.
            scale: As in ``Alignment``.
            shift: Likewise.
            unit_ray: Whether to take planar depth as distance along the ray: equation 9's letter.
        """
        if depth.kind != "inverse":
            return cls(depth.values, scale, depth.kind == "ray" or unit_ray, camera)
        inverse = scale * depth.values + shift
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.where(inverse > 0, 1.0 / inverse, np.nan).astype(np.float32)
        return cls(values, 1.0, unit_ray, camera)

    def every(self, first: int, step: int) -> Float32[np.ndarray, "h w"]:
        """Planar depth, before multiplication by the scale, at every ``step``-th row and column."""
        z = self.values[first::step, first::step].copy()
        if self.along_ray:
            row, column = (np.arange(first, size, step) for size in self.values.shape)
            z /= ray_length(self.camera, column, row[:, None]).astype(np.float32)
        z[~(z < np.inf)] = np.nan
        return np.asarray(z)

    def whole(self) -> Float64[np.ndarray, "H W"]:
        """Planar depth in scene units of every pixel."""
        return self.every(0, 1) * np.float64(self.scale)

    def at(self, pixel: Int64[np.ndarray, " C"]) -> Float32[np.ndarray, " C"]:
        """Planar depth in scene units of pixels numbered row * W + column, [C]."""
        z = self.values.ravel()[pixel] * self.scale
        if self.along_ray:
            row, column = np.divmod(pixel, self.camera.width)
            z = z / ray_length(self.camera, column, row)
        return np.asarray(z, np.float32)


def lift_pixels(
    pixel: Int64[np.ndarray, " C"],
    z: Float32[np.ndarray, " C"],
    camera: Camera,
    out: Float32[np.ndarray, "C 3"],
    factor: float = 1.0,
) -> Float32[np.ndarray, "C 3"]:
    """Write the world positions of pixels into ``out`` [C, 3], and return it.

    Equation 9: P = c + z v, where v is the ray through the pixel's centre, with unit z in camera
    axes; the text's P = c + s d v / |v| is the same with z = s d / |v|.

    Args:
        pixel: Numbers row * W + column, [C].
        z: Their planar depth, scene units, [C].
        camera: The camera whose pixels they are.
        out: The output array.
        factor: Multiplies depth.
    """
    world_from_pixel = camera.cam_from_world[:3, :3].T @ np.linalg.inv(camera.K)
    _lift(pixel, z, camera.width, world_from_pixel, camera.center, factor, out)
    return out


@inline
def _lift(pixel, depth, width, m, center, factor, xyz):  # type: ignore[no-untyped-def]  # Numba's types
    """P = c + z M (u, v, 1), in float64."""
    for k in range(len(pixel)):
        u, v = pixel[k] % width + 0.5, pixel[k] // width + 0.5
        z = factor * np.float64(depth[k])
        for axis in range(3):
            xyz[k, axis] = center[axis] + z * (m[axis, 0] * u + m[axis, 1] * v + m[axis, 2])
