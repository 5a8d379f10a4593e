"""Check poses by comparing photographs, and draw the random points that trainers start from.

The *agreement* of a photograph is the fraction of its pixels whose depth other photographs confirm,
by stereo over all depths on photographs of ``side`` pixels. Masked pixels do not count. A scene is
refused only if its photographs agree no more than by chance, or clearly better once a common
mistake of convention (``CORRECTIONS``) is undone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Camera
from splatseed.checkup.focal_by_pairs import find_focal_length
from splatseed.checkup.pose_accuracy import estimate_pose_error
from splatseed.depth.stereo.coarse import prior_from_baseline
from splatseed.depth.stereo.maps import StereoResult, StereoSettings
from splatseed.depth.stereo.matching import match_views, valid_blocks
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.photos.loading import load_views
from splatseed.photos.sizes import factor_for_size
from splatseed.photos.sources import choose_by_pose
from splatseed.photos.visibility import points_in_image
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent
from splatseed.projection import camera_centers, pixel_centers
from splatseed.sampling import strided
from splatseed.scene import Image, Scene
from splatseed.text import quoted

Poses = Float64[np.ndarray, "V 4 4"]


_STEREO = StereoSettings(grid=4, sweeps=6, tolerance=0.03, max_cost=0.4)


@dataclass(frozen=True)
class _Settings:
    """How photographs are compared, and what their agreement means."""

    side: int = 200
    """Maximum longer side of the photographs, in pixels."""
    partners: int = 5
    """Views that a photograph is compared with."""
    samples: int = 3
    """Photographs compared while the poses are neither clearly sound nor clearly wrong."""
    stereo: StereoSettings = _STEREO
    sound: float = 0.3
    """Agreement at which no correction is tried; wrong poses reached 0.17."""
    clear_factor: float = 2.0
    """Factor by which one agreement must exceed another to be clearly better."""
    min_corrected: float = 0.1
    """Minimum agreement of a correction."""
    chance: float = 0.03
    """Agreement that photographs of eleven captures reached with their poses exchanged; with their
    own, the hardest reached 0.07."""
    low: float = 0.15
    """Agreement below which few points are to be expected: bare rooms and corridors have 0.08 and
    0.09, seven other captures 0.26 and more."""
    few: int = 12
    """Photographs up to which too little overlap is as likely a reason as wrong poses."""
    overlap_samples: int = 24
    """Photographs that are tested for overlap with all others."""


POSE_CHECK = _Settings()
_YZ, _XY = np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])
CORRECTIONS: Mapping[str, Callable[[Poses], Poses]] = MappingProxyType(
    {
        "the y and z axes of every camera are negated": lambda poses: _YZ @ poses,
        "the x and y axes of every camera are negated": lambda poses: _XY @ poses,
        "every pose is inverted": np.linalg.inv,
        "every pose is inverted and its camera's y and z axes are negated": (
            lambda poses: _YZ @ np.linalg.inv(poses)
        ),
    }
)


class WrongConventionError(SceneFormatError):
    """Photographs agree clearly better once a common mistake of convention is undone."""


class InexactPosesError(SceneFormatError):
    """Photographs agree nowhere, and their poses miss by an error that refinement can correct."""


def check_poses(scene: Scene, images: Sequence[Image], progress: Progress = silent) -> float:
    """Return the mean agreement of a few photographs, or refuse their poses, within seconds.

    Raises:
        SceneNotFoundError: There are fewer than two photographs.
        SceneFormatError: All cameras are in one place; no two photographs overlap; they agree
            nowhere, or clearly better by another convention; or a photograph cannot be used.
    """
    poses = np.array([image.camera.cam_from_world for image in images])
    _check_centers(poses)
    expected = f"photographs that agree at the poses of {scene.source.root}"
    clear = POSE_CHECK.clear_factor
    agreements: list[float] = []
    for sample in range(POSE_CHECK.samples):
        progress("check poses", sample / POSE_CHECK.samples)
        agreement = _agreement(scene, images, poses, sample)
        agreements.append(agreement)
        if agreement >= POSE_CHECK.sound:
            break
        corrected = {
            name: _agreement(scene, images, correct(poses), sample)
            for name, correct in CORRECTIONS.items()
        }
        best = max(corrected, key=lambda name: corrected[name])
        if corrected[best] >= max(clear * agreement, POSE_CHECK.min_corrected):
            found = f"a depth that others confirm at {agreement:.1%} of their pixels"
            raise WrongConventionError(
                expected,
                found=f"{found}, and at {corrected[best]:.0%} once {best}",
                fix=f"Write the poses so: {scene.source.convention}.",
            )
        if agreement > max(clear * corrected[best], POSE_CHECK.chance):
            # The poses are sound; the mean agreement needs more than one photograph.
            rest = range(sample + 1, POSE_CHECK.samples)
            agreements += [_agreement(scene, images, poses, other) for other in rest]
            break
    else:
        if (mean := float(np.mean(agreements))) <= POSE_CHECK.chance:
            raise _disagreement(scene, images, expected, mean)
    progress("check poses", 1.0)
    return float(np.mean(agreements))


def _disagreement(
    scene: Scene, images: Sequence[Image], expected: str, agreement: float
) -> SceneFormatError:
    """Return the error for photographs that agree by chance at most."""
    sfm = f"splatseed sfm {quoted(scene.source.image_dir or 'IMAGES')} -o SCENE"
    if not _any_overlap([image.camera for image in images]):
        return SceneFormatError(
            f"photographs that show the same places, at the poses of {scene.source.root}",
            found=f"no two of {len(images)} that overlap at any depth",
            fix=f"Take more photographs in between, or estimate new poses: {sfm}.",
        )
    error = estimate_pose_error(scene, images)
    # With points, focal lengths have been tried by them.
    if not len(scene.points) and (other := find_focal_length(scene, images, error)):
        return SceneFormatError(expected, found=other[0].text.rstrip("."), fix=other[0].fix)
    inexact = error is not None and not error.exact
    found = f"a depth that others confirm at {agreement:.1%} of their pixels"
    new_poses = f"or estimate new poses: {sfm}."
    if len(images) <= POSE_CHECK.few:
        new_poses += " Few photographs may also show too little in common: take more in between."
    if inexact:
        found += f"; they miss each other by about {error}"
        fix = f"Correct the poses with `refine_poses=True`, {new_poses}"
        return InexactPosesError(expected, found=found, fix=fix)
    fix = f"Check that poses and names of the images belong together, {new_poses}"
    return SceneFormatError(expected, found=found, fix=fix)


def agreement_findings(
    agreement: float, masked: float = 0.0, *, stated: bool = False
) -> tuple[Finding, ...]:
    """Explain a low result of ``check_poses``; nothing if it is not low.

    Args:
        agreement: The result.
        masked: Fraction of the pixels that masks leave out.
        stated: Whether the share of pixels with a confirmed depth has been stated, by all
            photographs instead of a few: two different numbers for it would confuse.
    """
    if agreement >= POSE_CHECK.low:
        return ()
    few = f" masks that leave {1 - masked:.0%} of the pixels," if masked >= 0.5 else ""
    what = "Likely reasons for so little are"
    if not stated:
        what = (
            f"The photographs agree on the depth of only {agreement:.0%} of the pixels that count, "
            "so method auto will find few points. Likely reasons are"
        )
    text = (
        f"{what}{few} light that changes between photographs, bare or shiny surfaces, or "
        "photographs far apart."
    )
    fix = (
        "Take more from closer together in constant light, or triangulate points (splatseed sfm "
        "--poses-from)."
    )
    return (Finding("low-agreement", text, fix=fix),)


def _check_centers(poses: Poses) -> None:
    """Refuse a single camera, and cameras that are all in one place."""
    if len(poses) < 2:
        raise SceneNotFoundError(
            "at least two photographs with a pose, as the scene has no points",
            found=f"{len(poses)}",
            fix="Add photographs: depth comes from comparing them. Test views do not count.",
        )
    centers = camera_centers(poses)
    apart = np.abs(centers - centers[0]).max()
    if apart <= np.finfo(np.float32).eps * np.abs(centers).max():
        raise SceneFormatError(
            "photographs from different places, as the scene has no points",
            found=f"all {len(poses)} cameras in one place, as in a panorama",
            fix="Take photographs while moving: cameras that only rotate show no depth.",
        )


def _agreement(scene: Scene, images: Sequence[Image], poses: Poses, sample: int) -> float:
    """Return the mean agreement of a sampled photograph and its partners at these poses."""
    stereo = compare_sample(scene, images, poses, sample)[0]
    shares = []
    for i, view in enumerate(stereo.views):
        confirmed = stereo.confirmed(i)
        if view.surface is not None:
            confirmed = confirmed[valid_blocks(view.surface, POSE_CHECK.stereo.grid)]
        if confirmed.size:
            shares.append(confirmed.mean())
    return float(np.mean(shares)) if shares else 0.0


def compare_samples(
    scene: Scene, images: Sequence[Image]
) -> Iterator[tuple[StereoResult, list[Image]]]:
    """Compare a few photographs with their partners over all depths, one after the other."""
    poses = np.stack([image.camera.cam_from_world for image in images])
    for sample in range(POSE_CHECK.samples):
        yield compare_sample(scene, images, poses, sample)


def compare_sample(
    scene: Scene, images: Sequence[Image], poses: Poses, sample: int
) -> tuple[StereoResult, list[Image]]:
    """Compare a sampled photograph and its partners at these poses; also return their images."""
    first = (2 * sample + 1) * len(images) // (2 * POSE_CHECK.samples)
    partners = choose_by_pose(poses, POSE_CHECK.partners)[first]
    idx = [first, *partners[partners >= 0].tolist()]
    chosen = [images[i] for i in idx]
    factor = factor_for_size(chosen, POSE_CHECK.side)
    loaded = load_views(scene, chosen, data_factor=factor, undistort=True, draft=True)
    views = [view.posed(poses[i]) for view, i in zip(loaded, idx, strict=True)]
    sources = choose_by_pose(poses[idx], POSE_CHECK.partners)
    priors = [prior_from_baseline(views, i, others) for i, others in enumerate(sources)]
    return match_views(views, priors, sources, POSE_CHECK.stereo, 0, silent), chosen


def _any_overlap(cameras: Sequence[Camera]) -> bool:
    """Whether a point at some depth in front of one camera falls into another's image."""
    uv = pixel_centers(4, 5).reshape(-1, 2) / [5, 4]
    for first in strided(cameras, POSE_CHECK.overlap_samples):
        for other in cameras:
            if gap := float(np.linalg.norm(first.center - other.center)):
                z = gap * np.repeat(np.geomspace(0.1, 1000.0, 12), len(uv))
                xyz = first.unproject(np.tile(uv * [first.width, first.height], (12, 1)), z)
                if len(points_in_image(other, xyz).point_idx):
                    return True
    return False


def random_start(
    scene: Scene, rng: np.random.Generator, trainer: Literal["gsplat", "nerfstudio"] = "gsplat"
) -> PointCloud:
    """Draw the points that a trainer starts from if a scene has none: uniform position and colour.

    gsplat 1.5.3's simple_trainer (``init_type`` random) draws 100,000 in a cube whose half side is
    3.3 times the largest distance of a camera from their mean; nerfstudio 1.1.5's splatfacto draws
    50,000 in a cube whose half side is 5 times the largest offset along an axis. Needs two cameras.
    """
    centers = np.stack([image.camera.center for image in scene.images])
    middle, num = centers.mean(axis=0), 50_000
    half = 5.0 * np.abs(centers - middle).max()
    if trainer == "gsplat":
        # Its world is centred at the median, over cameras, of the point on the optical axis that is
        # nearest to the origin. It is rotated, too, which slightly changes a median of coordinates.
        axes = np.stack([image.camera.cam_from_world[2, :3] for image in scene.images])
        nearest = centers - (centers * axes).sum(axis=1, keepdims=True) * axes
        half = 3.0 * 1.1 * np.linalg.norm(centers - middle, axis=1).max()
        middle, num = np.median(nearest, axis=0), 100_000
    xyz = middle + half * rng.uniform(-1.0, 1.0, (num, 3))
    return PointCloud(xyz.astype(np.float32), rng.integers(0, 256, (num, 3), dtype=np.uint8))
