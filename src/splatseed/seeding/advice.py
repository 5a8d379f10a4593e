"""Which seeds? The one answer: what to do with a scene's points before training, and why.

*Room* is the number of seeds with which training can begin under its budget, per point of the
scene. ``advise`` depends only on the measurements and the plan, so that it can be tested against a
benchmark's runs. The rules rest on validation views of eight captures at 1,500 steps
(benchmarks/README.md): where Structure-from-Motion left room, on six, ``auto`` gained -0.12 to 0.50
dB under 3DGS's densification, 0.24 on average, and -0.30 to 0.28 under strategy ``grow``, -0.02 on
average, with a quarter of a Gaussian per pixel; with one per pixel 0.27 and 0.28 on average, the
latter from one capture (dorm, 1.27; the others at most 0.24). Where its points alone filled the
budget (bonsai, treehill), adding points cost up to 0.4 dB.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from splatseed.io.seeds import was_upsampled
from splatseed.methods import Upsampler
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene

DEFAULT_METHOD, FALLBACK = "auto", "mls"
"""The default method, and its replacement for scenes without photographs."""
AS_IT_IS, SEEDED = "sfm", "seeded"
"""The advice to leave the points as they are; and to train, as splatseed has made them already."""
ROOM = 1.1
"""Least room at which new points are worth making. On validation views fox gained 0.5 dB and face
lost 0.12, both with a room of 1.15, and scenes with a room of 1.0 lost."""
SAME_WAY = 0.95  # least length of the mean viewing direction at which cameras face one way
INWARD = 0.7
"""Least share of cameras that look towards the point nearest to all optical axes in an orbit."""


@dataclass(frozen=True)
class Measured:
    """Measurements of a scene."""

    num_points: int  # distinct ones
    pixels: float  # of one photograph
    empty: float | None = None  # share of the photographs' cells without a point, if known
    layout: str | None = None  # of its cameras; None for fewer than three
    photographs: bool = True  # whether they exist
    depth_maps: bool = False  # whether there are any


@dataclass(frozen=True)
class Advice:
    """What to do, a sentence for each reason, and the numbers on which it rests.

    ``method`` is the method for new points, ``AS_IT_IS`` or ``SEEDED``.
    """

    method: str
    reasons: tuple[str, ...]
    measured: Measured

    @property
    def sentence(self) -> str:
        """What to do, in a few words."""
        told = {SEEDED: "train it", AS_IT_IS: "leave the points as they are"}
        return told.get(self.method, f"add points by method {self.method}")


def advice_for(
    scene: Scene, max_seeds: int, *, strategy: str = "default", empty: float | None = None
) -> Advice:
    """What to do with a scene's points before training; no photograph is opened.

    Training can begin with ``max_seeds`` under its budget; ``empty`` is the share of the
    photographs' cells without points, if known.
    """
    measured = measure(scene, empty)
    if was_upsampled(scene) and len(scene.points):
        kept = scene.points.num_original
        new = f"{len(scene.points) - kept:,} of its points and kept {kept:,}"
        made = f"splatseed upsample made {new}."
        return Advice(SEEDED if scene.has_photographs else AS_IT_IS, (made,), measured)
    return advise(measured, max_seeds, strategy=strategy)


def method_for(
    scene: Scene | PointCloud,
    method: str | Upsampler = DEFAULT_METHOD,
    note: Callable[[str], None] = lambda _: None,
) -> str | Upsampler:
    """The default method, or its replacement if there are no photographs."""
    if isinstance(scene, Scene) and scene.has_photographs:
        return method
    note(f"Without photographs, method {FALLBACK} is used instead of {DEFAULT_METHOD}.")
    return FALLBACK


def advise(
    measured: Measured, max_seeds: int, *, strategy: str = "default", room: float = ROOM
) -> Advice:
    """The rule behind ``advice_for``, which scoring calls with other values of ``room``."""
    if not measured.num_points:
        maps = "Its depth maps can give some, too: --method depth --depth.no-align --num-points N."
        how = ": depth comes from comparing the photographs" if measured.photographs else ""
        none = f"There are no points to begin with{how}."
        return Advice(DEFAULT_METHOD, (none, *([maps] if measured.depth_maps else [])), measured)
    if not measured.photographs:
        return Advice(
            FALLBACK, ("Without photographs and their poses, points are interpolated.",), measured
        )
    has = max_seeds / measured.num_points
    share = measured.num_points / measured.pixels if measured.pixels else 0.0
    share_said = f"{share:.2f}" if share >= 0.01 or not share else f"{share:.1g}"
    per_pixel = f"{measured.num_points:,} points, {share_said} per pixel"
    if has < room:
        full = (
            f"Training begins with {max_seeds:,} at most, so there is no room for more: adding "
            "some cost up to 0.4 dB where that was measured."
        )
        return Advice(AS_IT_IS, (f"It has {per_pixel}.", full), measured)
    if strategy == "grow":
        places_itself = (
            "Strategy grow puts new Gaussians at the depth that stereo finds; adding points by "
            "method auto first gained or lost 0.3 dB at most on all but one of the captures "
            "measured. Under 3DGS's densification, which other trainers use, that gained 0.2 dB on "
            "average: splatseed upsample adds them."
        )
        return Advice(AS_IT_IS, (f"It has {per_pixel}.", places_itself), measured)
    reasons = [f"It has {per_pixel}, and room for {has:.1f} times as many seeds."]
    if measured.depth_maps:
        return Advice("depth", (*reasons, "Its depth maps say where the surfaces are."), measured)
    if measured.empty is not None:
        cells = f"{measured.empty:.0%} of the cells of a coarse grid over the pictures"
        reasons.append(f"No point falls in {cells}.")
    return Advice(DEFAULT_METHOD, tuple(reasons), measured)


def measure(scene: Scene, empty: float | None = None) -> Measured:
    """Measure a scene without looking at its photographs; ``empty`` as in ``advice_for``."""
    points = scene.points.originals
    sizes = [image.intrinsics.width * image.intrinsics.height for image in scene.images]
    return Measured(
        num_points=int(np.count_nonzero(points.distinct)),
        pixels=float(np.median(sizes)) if sizes else 0.0,
        empty=empty,
        layout=camera_layout(scene),
        photographs=scene.has_photographs,
        depth_maps=scene.depths is not None and bool(len(scene.depths)),
    )


def camera_layout(
    scene: Scene,
) -> Literal["facing one way", "around something", "through a place"] | None:
    """The layout of a scene's cameras; None for fewer than three."""
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
