"""Advice: what to do with a scene's points before training, from what is measured in seconds.

Notation: *room* is how many seeds training can begin with under its budget, per point that the
scene has. Promise: ``advise`` is a function of what was measured and of the plan, without files or
chance, so that it can be held against a benchmark's ledger (``bench.analysis.advice_score``); it
may say that nothing is to be done.

What the rules stand on, on validation views at 1,500 steps (benchmarks/README.md): where
Structure-from-Motion left room (fern, fox) ``auto`` gave 0 to 0.5 dB with densification and 1.1 to
1.5 dB without; where its points alone filled the budget (bonsai, treehill) whatever was added cost
up to 0.4 dB.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from splatseed.progress import Progress, silent
from splatseed.scene import Scene

__all__ = [
    "AS_IT_IS",
    "ROOM",
    "Advice",
    "Layout",
    "Measured",
    "advise",
    "camera_layout",
    "measure",
    "stereo_agreement",
]

Layout: TypeAlias = Literal["facing one way", "around something", "through a place"]
AS_IT_IS = "sfm"
"""The advice to leave the points as they are."""
ROOM = 1.3
"""Room from which on new points are worth making."""
LOW_AGREEMENT = 0.15
"""Share of pixels with confirmed depth below which stereo finds little."""
FEW_EMPTY = 0.05
"""Share of the pictures without points below which there is nothing to cover."""
SAME_WAY = 0.95
"""Length of the mean of the viewing directions, from which on cameras face one way."""
INWARD = 0.7
"""Share of cameras that look towards the point nearest to all optical axes, in an orbit."""
VIEWS_LOOKED_AT = 2
SIDE_LOOKED_AT = 400
"""Pixels of the longer side at which stereo is tried: a few seconds a view with its neighbours."""


@dataclass(frozen=True)
class Measured:
    """What is known of a scene.

    Args:
        num_points: Distinct points.
        num_images: Images with a pose.
        pixels: Of one photograph.
        empty: Share of the pictures, in cells, that no point falls in, 0 to 1; None if not known.
        layout: How its cameras stand; None for fewer than three.
        photographs: Whether they are there.
        depth_maps: Whether each photograph has one.
        agreement: Share of pixels whose depth by stereo other views confirm; None if not tried.
    """

    num_points: int
    num_images: int
    pixels: float
    empty: float | None = None
    layout: Layout | None = None
    photographs: bool = True
    depth_maps: bool = False
    agreement: float | None = None

    @property
    def points_per_pixel(self) -> float:
        """Points of the scene per pixel of one photograph."""
        return self.num_points / self.pixels if self.pixels else 0.0


@dataclass(frozen=True)
class Advice:
    """What to do, and why.

    Args:
        method: How to make new points, or ``AS_IT_IS``.
        reasons: One sentence each.
    """

    method: str
    reasons: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """What to do, in a few words."""
        if self.method == AS_IT_IS:
            return "leave the points as they are"
        return f"add points by method {self.method}"


def advise(found: Measured, most_seeds: int, *, room: float = ROOM) -> Advice:
    """What to do with a scene's points.

    Args:
        found: What is known of the scene.
        most_seeds: Seeds that training can begin with under its budget.
        room: From how much room on new points are worth making; fitted by whoever scores this.
    """
    if not found.num_points:
        return Advice("auto", ("There are no points to begin with.",))
    if not found.photographs:
        return Advice("mls", ("There are no photographs to look at, so points are interpolated.",))
    has = most_seeds / found.num_points
    per_pixel = f"{found.num_points:,} points, {found.points_per_pixel:.2f} per pixel"
    if has < room:
        full = (
            f"It has {per_pixel}; training begins with {most_seeds:,} at most, so there is no "
            "room for more: adding some cost up to 0.4 dB where that was measured."
        )
        return Advice(AS_IT_IS, (full,))
    reasons = [f"It has {per_pixel}, and room for {has:.1f} times as many seeds."]
    if found.depth_maps:
        return Advice("depth", (*reasons, "Its depth maps say where the surfaces are."))
    if found.empty is not None:
        reasons.append(f"No point falls in {found.empty:.0%} of the pictures.")
    if found.agreement is not None:
        reasons.append(f"Stereo finds a confirmed depth for {found.agreement:.0%} of the pixels.")
    little = found.agreement is not None and found.agreement < LOW_AGREEMENT
    if little and found.empty is not None and found.empty < FEW_EMPTY:
        return Advice(AS_IT_IS, (*reasons, "That is too little to add to what there is."))
    return Advice("auto", tuple(reasons))


def measure(scene: Scene, empty: float | None = None, pixels: float | None = None) -> Measured:
    """What is known of a scene without looking at its photographs.

    Args:
        scene: The scene.
        empty: Share of the pictures without points, if it is known.
        pixels: Of a photograph at the size that is trained; the median camera's when left out.
    """
    points = scene.points.originals
    sizes = [image.intrinsics.width * image.intrinsics.height for image in scene.images]
    return Measured(
        num_points=int(np.count_nonzero(points.distinct)),
        num_images=len(scene.images),
        pixels=float(np.median(sizes)) if pixels is None and sizes else pixels or 0.0,
        empty=empty,
        layout=camera_layout(scene),
        photographs=scene.has_photographs,
        depth_maps=scene.depths is not None and bool(len(scene.depths)),
    )


def camera_layout(scene: Scene) -> Layout | None:
    """How a scene's cameras stand; None for fewer than three."""
    if len(scene.images) < 3:
        return None
    world_from_cam = [np.linalg.inv(image.camera.cam_from_world) for image in scene.images]
    axes = np.array([pose[:3, 2] for pose in world_from_cam])
    centers = np.array([pose[:3, 3] for pose in world_from_cam])
    if np.linalg.norm(axes.mean(axis=0)) >= SAME_WAY:
        return "facing one way"
    # The point nearest to all axes: sum of (I - a a') (x - c) is 0.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    right = (across @ centers[:, :, None]).sum(axis=0)[:, 0]
    middle = np.linalg.lstsq(across.sum(axis=0), right, rcond=None)[0]
    towards = middle - centers
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    inward = (towards * axes).sum(axis=1) > INWARD
    return "around something" if inward.mean() > INWARD else "through a place"


def stereo_agreement(scene: Scene, seed: int = 0, progress: Progress = silent) -> float:
    """The share of the pixels of a few views whose depth by stereo other views confirm, 0 to 1.

    Args:
        scene: With photographs.
        seed: The same seed gives the same bytes.
        progress: Told how far it is.

    Raises:
        SceneNotFoundError: There are no photographs.
        SceneFormatError: One is damaged.
    """
    from splatseed.seeding.photographs import Stereo, photographed  # noqa: PLC0415  (Numba with use)

    count = len(photographed(scene))
    some = min(VIEWS_LOOKED_AT, count)
    only = [(2 * i + 1) * count // (2 * some) for i in range(some)]
    maps = Stereo(max_size=SIDE_LOOKED_AT).maps(scene, only, seed, progress)
    return float(np.mean([np.isfinite(each.depth).mean() for each in maps]))
