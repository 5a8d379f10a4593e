"""The clouds that benchmarks run on: a made room of any size, and real captures where there are.

Notation: N points, xyz float32 in scene units (the room's metres), rgb uint8. Promise: a made cloud
is the same for the same size and seed. Its density varies smoothly, several times from place to
place, as in Structure-from-Motion, where points gather on texture.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from splatseed import PointCloud, Scene
from splatseed.errors import SceneNotFoundError
from splatseed.io import load_scene
from splatseed.synthetic.surfaces import Box, Cylinder, Rectangle, Sphere, Surface, Union, yaw_frame

__all__ = [
    "REAL_SCENES",
    "find_cases",
    "find_scenes",
    "load_cloud",
    "room",
    "room_surfaces",
    "sample_unevenly",
]

REAL_SCENES = {
    "bonsai": "bonsai",
    "treehill": "treehill",
    "fox": "fox",
    "fern": "fern",
    "bicycle": "mipnerf360_sfm/bicycle/sparse/0/points3D.ply",
    "stump": "mipnerf360_sfm/stump/sparse/0/points3D.ply",
}
"""Where each real cloud lies in the folder of captures."""

NOISE = 0.002
"""Standard deviation of the made room's points, in metres: a few millimetres, as SfM indoors."""
OVERSAMPLING = 4
WAVES = 8


def room(num: int, seed: int = 0) -> PointCloud:
    """A furnished room of ``num`` points with unevenly spread texture."""
    rng = np.random.default_rng(seed)
    xyz = sample_unevenly(room_surfaces(), num, rng, wavelength=1.0)
    xyz += rng.normal(scale=NOISE, size=xyz.shape)
    return PointCloud(xyz.astype(np.float32), _paint(xyz))


def room_surfaces() -> Union:
    """Floor, ceiling, four walls, two boxes, a ball and a column; 6 x 5 x 2.5 metres."""
    low, size = np.array([-3.0, -2.5, 0.0]), np.array([6.0, 5.0, 2.5])
    x, y, z = np.diag(size)
    faces = ((low, x, y), (low, y, z), (low, z, x))
    opposite = ((low + z, x, y), (low + x, y, z), (low + y, z, x))
    walls = [Rectangle(*face) for face in (*faces, *opposite)]
    return Union(
        (
            *walls,
            Box(np.array([-1.0, 0.5, 0.4]), np.array([0.8, 0.5, 0.4]), yaw_frame(25.0)),
            Box(np.array([1.8, -1.2, 0.9]), np.array([0.3, 0.4, 0.9]), yaw_frame(-10.0)),
            Sphere(np.array([-1.0, 0.5, 1.15]), 0.35),
            Cylinder(np.array([1.0, 1.2, 1.25]), yaw_frame(0.0), 0.2, 2.5),
        )
    )


def sample_unevenly(
    surface: Surface, num: int, rng: np.random.Generator, wavelength: float
) -> Float64[np.ndarray, "num 3"]:
    """Points [num, 3] on a surface, in patches about ``wavelength`` (scene units) wide.

    Of four times as many uniform points, each is kept with odds exp(field), where the field is a
    random sum of plane waves with a standard deviation of 1.
    """
    candidates = surface.sample(OVERSAMPLING * num, rng)
    waves = rng.normal(scale=2.0 * np.pi / wavelength / np.sqrt(3.0), size=(3, WAVES))
    phases = rng.uniform(0.0, 2.0 * np.pi, WAVES)
    field = np.sqrt(2.0 / WAVES) * np.cos(candidates @ waves + phases).sum(axis=1)
    # The num largest of field + Gumbel noise are a weighted draw without replacement.
    keys = field + rng.gumbel(size=len(field))
    kept = np.argpartition(keys, -num)[-num:]
    return np.asarray(candidates[np.sort(kept)])


def _paint(xyz: Float64[np.ndarray, "N 3"]) -> UInt8[np.ndarray, "N 3"]:
    """Colours that vary smoothly with the place."""
    return (127.5 + 127.0 * np.sin(3.0 * xyz + np.array([0.0, 2.0, 4.0]))).astype(np.uint8)


def find_scenes() -> Path:
    """The folder of real captures: ``SPLATSEED_SCENES``, or where the tests look for them.

    Raises:
        SceneNotFoundError: There is none on this machine.
    """
    return _find("SPLATSEED_SCENES", "scenes", "real captures", ", or use the made room")


def find_cases() -> Path:
    """The folder of builders of inputs: ``SPLATSEED_CASES``, or beside the captures.

    Raises:
        SceneNotFoundError: There is none on this machine.
    """
    return _find("SPLATSEED_CASES", "cases", "builders of inputs")


def _find(variable: str, name: str, what: str, instead: str = "") -> Path:
    beside = Path(__file__).parents[3] / "shared" / name
    folder = Path(os.environ.get(variable, beside))
    if not folder.is_dir():
        raise SceneNotFoundError(
            f"the folder of {what}",
            found="none on this machine",
            fix=f"Set {variable} to it{instead}.",
        )
    return folder


def load_cloud(name: str) -> PointCloud:
    """The cloud of a real capture, one of ``REAL_SCENES``.

    Raises:
        SceneNotFoundError: No such capture on this machine.
    """
    if name not in REAL_SCENES:
        raise SceneNotFoundError(
            f"one of the captures {', '.join(REAL_SCENES)}",
            found=repr(name),
            fix="Choose one of these.",
        )
    scene: Scene = load_scene(find_scenes() / REAL_SCENES[name])
    return scene.points.select(scene.points.finite)
