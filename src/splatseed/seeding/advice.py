"""Advice: whether a scene can be trained, whether to add points before, by which method, and why.

*Room* is the number of seeds that training starts with under its budget, per point of the scene.
``advise`` depends on the measurements and the plan alone, so benchmark runs can test it. The rules
rest on validation views of eight captures at 1,500 steps (benchmarks/training/README.md): where
Structure-from-Motion left room, on six, ``auto`` gained -0.12 to 0.50 dB under 3DGS's
densification, 0.24 on average, and -0.30 to 0.28 under strategy ``grow``, -0.02 on average, with a
quarter of a Gaussian per pixel; with one per pixel 0.27 and 0.28 on average, the latter from one
capture (dorm, 1.27; the others at most 0.24). Where its points alone filled the budget (bonsai,
treehill), adding points cost up to 0.4 dB. Under ``grow`` the share of the pictures' cells without
a point distinguishes dorm from the others: below ``MAX_BARE`` ``auto`` gained -0.28 to 0.24 dB,
above it -0.15 to 1.27, and up to 2.7 in short runs. That predicts nothing for another capture, so
advice gives no gain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from splatseed.depthmap import in_scene_units
from splatseed.findings import Finding
from splatseed.io.files import special_kind
from splatseed.io.seeds import was_upsampled
from splatseed.methods import Upsampler
from splatseed.pointcloud import PointCloud
from splatseed.progress import Note, silent_note
from splatseed.scene import Scene
from splatseed.text import agreeing, visible

DEFAULT_METHOD, FALLBACK = "auto", "mls"
"""The default method, and the method for scenes without photographs."""
AS_IT_IS, SEEDED = "sfm", "seeded"
"""Advice to leave the points as they are, and to train points that splatseed made before."""
MIN_ROOM = 1.1
"""Smallest room at which new points help. On validation views fox gained 0.5 dB and face
lost 0.12, both with a room of 1.15, and scenes with a room of 1.0 lost."""
MAX_BARE = 0.35
"""Share of the photographs' cells without a point from which on ``auto`` helps a strategy that adds
Gaussians at depths of its own."""
MIN_MEAN_DIRECTION = 0.95
"""Length of the mean viewing direction from which on cameras face one way."""
MIN_INWARD = 0.7
"""Smallest cosine at which a camera looks at the point nearest to all optical axes, and smallest
share of such cameras in an orbit."""


@dataclass(frozen=True)
class Measured:
    """Measurements of a scene that advice depends on."""

    num_points: int  # distinct originals
    pixels: float  # median pixels of a photograph
    empty: float | None = None  # share of the photographs' cells without a point; None: unknown
    layout: str | None = None  # of the cameras; None for fewer than three
    photographs: bool = True  # whether any exist
    depth_maps: bool = False  # whether any exist
    metric_maps: bool = False  # whether they are in scene units, so that method auto uses them


@dataclass(frozen=True)
class Advice:
    """A method for new points (or ``AS_IT_IS``, ``SEEDED``), its reasons, and the measurements."""

    method: str
    reasons: tuple[str, ...]
    measured: Measured

    @property
    def sentence(self) -> str:
        """The advice as an imperative, for messages."""
        others = {SEEDED: "train it", AS_IT_IS: "leave the points as they are"}
        return others.get(self.method, f"add points by method {self.method}")


def advice_for(
    scene: Scene, max_seeds: int, *, why_no_seeds: str = "", empty: float | None = None
) -> Advice:
    """Advise on a scene's points before training, without opening a photograph.

    Args:
        scene: The scene.
        max_seeds: Seeds that training starts with under its budget.
        why_no_seeds: Why the strategy of training gains nothing by more points than the scene has;
            empty if it gains.
        empty: Share of the photographs' cells without points, if known.
    """
    measured = measure(scene, empty)
    if was_upsampled(scene) and len(scene.points):
        kept = scene.points.num_original
        new = f"{len(scene.points) - kept:,} of its points and kept {kept:,}"
        made = f"splatseed upsample made {new}."
        return Advice(SEEDED if scene.has_photographs else AS_IT_IS, (made,), measured)
    return advise(measured, max_seeds, why_no_seeds=why_no_seeds)


def method_for(
    scene: Scene | PointCloud, method: str | Upsampler = DEFAULT_METHOD, note: Note = silent_note
) -> str | Upsampler:
    """Return ``method`` if there are photographs, else ``FALLBACK``, with a note."""
    if isinstance(scene, Scene) and scene.has_photographs:
        return method
    text = f"Without photographs, method {FALLBACK} is used instead of {DEFAULT_METHOD}."
    note(Finding("fallback-method", text, "info"))
    return FALLBACK


def advise(
    measured: Measured, max_seeds: int, *, why_no_seeds: str = "", room: float = MIN_ROOM
) -> Advice:
    """Apply the rules behind ``advice_for``; benchmarks vary ``room``."""
    if not measured.num_points:
        maps = "Its depth maps can give some, too: `method='depth'`, `depth.align=False`, "
        maps += "`num_points=N`."
        how = ": depth comes from comparing the photographs" if measured.photographs else ""
        if measured.metric_maps and measured.photographs:
            how += ", and from its depth maps where they confirm none"
        none = f"There are no points to start with{how}."
        unaligned = measured.depth_maps and not measured.metric_maps
        return Advice(DEFAULT_METHOD, (none, *([maps] if unaligned else [])), measured)
    if not measured.photographs:
        return Advice(
            FALLBACK, ("Without photographs and their poses, points are interpolated.",), measured
        )
    has = max_seeds / measured.num_points
    share = measured.num_points / measured.pixels if measured.pixels else 0.0
    shown = f"{share:.2f}" if share >= 0.01 or not share else f"{share:.1g}"
    size = f" of a photograph's {measured.pixels:,.0f}" if measured.pixels else ""
    per_pixel = f"{measured.num_points:,} distinct points, {shown} per pixel{size}"
    bare = ""
    if measured.empty is not None:
        bare = f"No point falls in {measured.empty:.0%} of the cells of a coarse grid over the "
        bare += "pictures"
    if has < room:
        full = f"Training starts with at most {max_seeds:,}, so there is no room for more."
        return Advice(AS_IT_IS, (f"It has {per_pixel}.", full), measured)
    if why_no_seeds and (measured.empty is None or measured.empty < MAX_BARE):
        covered = f"{bare}. {why_no_seeds}" if bare else why_no_seeds
        return Advice(AS_IT_IS, (f"It has {per_pixel}.", covered), measured)
    reasons = [f"It has {per_pixel}, and room for {has:,.1f} times as many seeds."]
    if measured.metric_maps:
        reasons.append("Where photographs confirm no depth, it is that of the depth maps.")
    elif measured.depth_maps:
        return Advice("depth", (*reasons, "Its depth maps show the surfaces."), measured)
    if bare:
        reasons.append(f"{bare}.")
    return Advice(DEFAULT_METHOD, tuple(reasons), measured)


def measure(scene: Scene, empty: float | None = None) -> Measured:
    """Measure a scene without reading a photograph's pixels; ``empty`` as in ``advice_for``."""
    points = scene.points.originals
    sizes = [image.camera.width * image.camera.height for image in scene.images]
    return Measured(
        num_points=int(np.count_nonzero(points.distinct)),
        pixels=float(np.median(sizes)) if sizes else 0.0,
        empty=empty,
        layout=camera_layout(scene),
        photographs=scene.has_photographs,
        depth_maps=scene.depths is not None and bool(len(scene.depths)),
        metric_maps=in_scene_units(scene.depths),
    )


def camera_layout(
    scene: Scene,
) -> Literal["facing one way", "around something", "through a place"] | None:
    """Classify the layout of a scene's cameras; None for fewer than three."""
    if len(scene.images) < 3:
        return None
    world_from_cam = [image.camera.world_from_cam for image in scene.images]
    axes = np.array([pose[:3, 2] for pose in world_from_cam])
    centers = np.array([pose[:3, 3] for pose in world_from_cam])
    if np.linalg.norm(axes.mean(axis=0)) >= MIN_MEAN_DIRECTION:
        return "facing one way"
    # The point nearest to all axes: sum of (I - a a') (x - c) is 0.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    right = (across @ centers[:, :, None]).sum(axis=0)[:, 0]
    middle = np.linalg.lstsq(across.sum(axis=0), right, rcond=None)[0]
    towards = middle - centers
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    inward = (towards * axes).sum(axis=1) > MIN_INWARD
    return "around something" if inward.mean() > MIN_INWARD else "through a place"


def untrainable(scene: Scene) -> Finding | None:
    """Return why no trainer can use the scene; None if one can.

    Lens distortion is not a reason, as it can be removed (``is_distorted``).
    """
    why = _why_untrainable(scene)
    return Finding("untrainable", why, "error") if why else None


def _why_untrainable(scene: Scene) -> str:
    if not scene.images:
        return "Points alone cannot be trained: training needs photographs and cameras."
    if not all(scene.split()) if scene.listed else len(scene.images) < 2:
        listed = "photographs to train on and to test in its lists"
        return f"Training needs {listed if scene.listed else 'at least two photographs'}."
    folder = scene.source.image_dir
    if folder is None:
        return "Training needs the photographs: put them beside the model in a folder named images."
    missing = [image.name for image in scene.images if not image.has_photograph]
    if 2 * len(missing) <= len(scene.images):
        return ""
    needs = f"Training needs at least half of the {len(scene.images):,} photographs"
    if kind := special_kind(folder / missing[0]):
        return f"{needs}: {visible(missing[0])} is {kind}."
    which = agreeing(len(missing), "", f"and {len(missing) - 1:,} more ")
    return f"{needs}: put {visible(missing[0])} {which}into {visible(folder)}."


def is_distorted(scene: Scene) -> bool:
    """Whether any camera has lens distortion."""
    return any(image.intrinsics.has_distortion for image in scene.images)
