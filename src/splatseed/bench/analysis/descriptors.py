"""A scene described by a few numbers.

Notation: l1 >= l2 >= l3 are the variances of a point and its 16 nearest along their principal axes;
h is a point's mean distance to its 6 nearest. Promise: all numbers are dimensionless, so that
scenes compare; only originals are described, never points that splatseed added; nothing is random.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Float64

from splatseed.errors import PointCloudError, SplatseedError
from splatseed.io.files import read_text
from splatseed.io.photograph import decode_photograph, photograph_bytes
from splatseed.io.staging import atomic_file
from splatseed.progress import Progress, in_threads, silent
from splatseed.scene import Image, Scene
from splatseed.seeding.diagnostics import empty_regions

if TYPE_CHECKING:  # SciPy and Numba
    from splatseed.upsample.neighbors import PreparedCloud

NEIGHBORS = 16
VIEWS = 24
"""Number of views, evenly spaced, for gaps, empty area and texture."""
SIDE = 320
"""Longer side of photographs at which their gradients are measured."""
BLOCK = 1 << 14
SCHEMA = 1

DESCRIPTIONS = {
    "planarity": "planarity",
    "linearity": "linearity",
    "scattering": "scattering",
    "curvature": "curvature",
    "gap": "wide gaps between points",
    "unevenness": "unevenly spaced points",
    "empty": "image area without points",
    "texture": "texture",
}
"""Each descriptor in words that can follow "scenes with more"."""


@dataclass(frozen=True)
class Descriptors:
    """The descriptors of a scene.

    Args:
        planarity: Mean of (l2 - l3) / l1, as Weinmann et al. (2015) define it.
        linearity: Mean of (l1 - l2) / l1, likewise.
        scattering: Mean of l3 / l1, likewise.
        curvature: Mean of l3 / (l1 + l2 + l3): the surface variation of Pauly et al. (2002).
        gap: Median of h as views see it, as a share of the image's longer side.
        unevenness: Standard deviation of the natural logarithm of h.
        empty: Mean share of the views' area that no point projects to; NaN without images.
        texture: Mean length of the gradient of grey values 0 to 1, per pixel of photographs made
            320 pixels large; NaN without photographs.
    """

    planarity: float
    linearity: float
    scattering: float
    curvature: float
    gap: float
    unevenness: float
    empty: float
    texture: float


def describe(scene: Scene, progress: Progress = silent) -> Descriptors:
    """The descriptors of a scene.

    Args:
        scene: With or without images; without photographs there is no texture.
        progress: Told the stages.

    Raises:
        PointCloudError: Fewer than four distinct finite originals.
    """
    from splatseed.upsample.neighbors import prepare  # noqa: PLC0415  (SciPy and Numba)

    originals = scene.points.originals
    cloud = prepare(originals, progress=progress)
    if len(cloud) < 4:
        raise PointCloudError(
            "at least 4 distinct finite points to describe a scene by",
            found=f"{len(cloud)}",
            fix="Check that the cloud was read correctly.",
        )
    neighbors = cloud.neighbors(NEIGHBORS)
    spread = _variances(cloud.xyz, neighbors.idx, progress)
    first, second, third = spread.T
    shown = scene.replace(points=originals, images=tuple(_some(scene)))
    regions = empty_regions(shown, progress)
    return Descriptors(
        planarity=float(((second - third) / first).mean()),
        linearity=float(((first - second) / first).mean()),
        scattering=float((third / first).mean()),
        curvature=float((third / spread.sum(axis=1)).mean()),
        gap=_gap(scene, cloud, neighbors.spacing),
        unevenness=float(np.log(neighbors.spacing).std()),
        empty=np.nan if regions is None else regions.mean,
        texture=_texture(scene, progress),
    )


def _variances(
    xyz: Float64[np.ndarray, "n 3"], idx: np.ndarray, progress: Progress
) -> Float64[np.ndarray, "n 3"]:
    """Variances of every row and its neighbours along their principal axes, greatest first."""
    variances = np.empty((len(xyz), 3))

    def work(start: int, stop: int) -> None:
        around = np.concatenate([xyz[start:stop, None], xyz[idx[start:stop]]], axis=1)
        around = around - around.mean(axis=1, keepdims=True)
        covariance = np.einsum("nki,nkj->nij", around, around) / around.shape[1]
        variances[start:stop] = np.linalg.eigvalsh(covariance)[:, ::-1]

    in_threads(work, len(xyz), BLOCK, "describe points", progress)
    return np.maximum(variances, 0.0)  # rounding makes a plane's least variance negative


def _gap(scene: Scene, cloud: PreparedCloud, spacing: Float64[np.ndarray, " n"]) -> float:
    """Median over views and their points of h f / z over the image's longer side."""
    xyz = cloud.xyz + cloud.center
    seen = []
    for image in _some(scene):
        camera = image.camera
        uv, depth = camera.project(xyz)
        inside = ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)  # NaN: behind
        seen.append(
            spacing[inside] * camera.K[0, 0] / depth[inside] / max(camera.width, camera.height)
        )
    values = np.concatenate([np.empty(0), *seen])
    return float(np.median(values)) if len(values) else np.nan


def _some(scene: Scene) -> list[Image]:
    """At most ``VIEWS`` images, evenly spaced in the order of their names."""
    images = sorted(scene.images, key=lambda image: image.name)
    count = min(VIEWS, len(images))
    return [images[(2 * i + 1) * len(images) // (2 * count)] for i in range(count)]


def _texture(scene: Scene, progress: Progress) -> float:
    folder = scene.source.image_dir if scene.source else None
    energies: list[float] = []
    for image in _some(scene) if folder is not None else []:
        progress("describe photographs", len(energies) / VIEWS)
        with suppress(SplatseedError):  # a photograph that cannot be read is not part of the mean
            energies.append(_energy(_grey(folder / image.name)))  # type: ignore[operator]  # checked by the caller
    return float(np.mean(energies)) if energies else np.nan


def _grey(path: Path) -> Float32[np.ndarray, "H W"]:
    picture = decode_photograph(path, photograph_bytes(path))
    scale = SIDE / max(picture.size)
    width, height = (max(round(side * scale), 2) for side in picture.size)
    small = picture.convert("L").resize((width, height), resample=_box())
    return np.asarray(small, np.float32) / np.float32(255)


def _box() -> int:
    from PIL import Image as PilImage  # noqa: PLC0415  (slow to import)

    return PilImage.Resampling.BOX


def _energy(grey: Float32[np.ndarray, "H W"]) -> float:
    across, down = np.diff(grey, axis=1)[:-1], np.diff(grey, axis=0)[:, :-1]
    return float(np.hypot(across, down).mean())


def read_descriptors(path: Path) -> dict[str, Descriptors]:
    """The descriptors that ``write_descriptors`` stored, by fingerprint; empty if unusable.

    Args:
        path: The file.
    """
    names = {field.name for field in fields(Descriptors)}
    with suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
        content = json.loads(read_text(path))
        if content["schema"] == SCHEMA:
            return {
                digest: Descriptors(
                    **{k: np.nan if v is None else float(v) for k, v in each.items()}
                )
                for digest, each in content["scenes"].items()
                if set(each) == names
            }
    return {}


def write_descriptors(path: Path, described: Mapping[str, Descriptors]) -> None:
    """Store descriptors by the scenes' fingerprints, so that they need not be recomputed.

    Args:
        path: The file.
        described: Descriptors by fingerprint.

    Raises:
        OutputError: The file cannot be written.
    """
    scenes = {
        digest: {k: None if np.isnan(v) else v for k, v in asdict(each).items()}
        for digest, each in sorted(described.items())
    }
    with atomic_file(path) as partial:
        text = json.dumps({"schema": SCHEMA, "scenes": scenes}, indent=2, allow_nan=False)
        partial.write_text(text + "\n", "utf-8")
