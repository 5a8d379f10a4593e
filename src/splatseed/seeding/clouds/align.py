"""Align a cloud with a scene, or refuse with the reason.

Notation: the scene's *extent* is the root mean square distance of its tie points from their
center, and the unit of all lengths here. The *inlier ratio* is the fraction of tie points within
``inlier_distance`` of the cloud. A *runner-up* is the best alignment that is distinct from the one
chosen: its rotation, scale or shift differs by more than ``AlignSettings`` allows. The *error* is
the standard error of the alignment at the farthest corner of the tie points; it is large where the
cloud may slide along the scene.

Global search (``global_search``) gives candidates, ICP (``icp.fit``) improves them in ever smaller
and more exact stages, and ``icp.refine`` the best. Nothing is random.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from splatseed.errors import PointCloudError
from splatseed.findings import Finding
from splatseed.progress import Progress, silent
from splatseed.sampling import strided
from splatseed.scene import Scene
from splatseed.seeding.clouds.global_search import SEARCH, SearchSettings, find_starts, to_unit_size
from splatseed.seeding.clouds.icp import CloudSurface, RefinedFit, SimilarityFit, Stage, fit, refine
from splatseed.seeding.clouds.reading import sample_cloud
from splatseed.seeding.clouds.tie_points import (
    MAX_TIE_POINTS,
    MIN_TIE_POINTS,
    Points,
    TiePoints,
    select_tie_points,
)
from splatseed.similarity import Similarity

MAX_ROTATION_ERROR = 0.1  # degrees above which (at two standard errors) the summary warns


@dataclass(frozen=True)
class AlignSettings:
    """Stages of an alignment, and when it counts as reliable; lengths are in extents."""

    search: SearchSettings = SEARCH
    stages: tuple[Stage, ...] = (
        Stage(100, 250, 20, first_reach=0.3, last_reach=0.04, decay=0.85, inlier_distance=0.04),
        Stage(16, 1500, 20, first_reach=0.2, last_reach=0.02, decay=0.82, inlier_distance=0.02),
        Stage(
            4, MAX_TIE_POINTS, 40,
            first_reach=0.04, last_reach=0.005, decay=0.75, inlier_distance=0.01,
        ),
    )  # fmt: skip
    """The first starts from orientations 15 degrees off, the second still has some that are 10 off,
    so their reach is wide and shrinks slowly."""
    inlier_distance: float = 0.01
    min_inlier_ratio: float = 0.5
    """0.75 in a good cloud (room0), 0.33 in a handheld depth camera's (red kitchen), where right
    and wrong alignments cannot be distinguished."""
    max_runner_up: float = 0.7
    """Maximum inlier ratio of the runner-up, relative to the best. Wrong alignments always have a
    runner-up above it."""
    distinct_degrees: float = 8.0
    distinct_log_scale: float = 0.08
    distinct_shift: float = 0.1
    colors_agree: float = 0.5
    """Minimum correlation of brightness that lets colours decide for the best alignment, ..."""
    colors_disagree: float = 0.25
    """... where the runner-up's is below this."""
    max_error: float = 0.003


ALIGNMENT = AlignSettings()


@dataclass(frozen=True, eq=False)
class CloudAlignment:
    """Where a cloud lies in a scene; lengths are in scene units."""

    scene_from_cloud: Similarity
    inlier_ratio: float
    median_residual: float  # of the inliers
    error: float  # standard error at the farthest corner
    rotation_error: float  # standard error, degrees
    principal_point_sensitivity: float  # degrees of rotation per half a pixel
    extent: float
    brightness_correlation: float | None  # of tie points and cloud; None without colours
    runner_up: float  # inlier ratio of the runner-up; 0 without one
    tie_points: Points
    residuals: Float64[np.ndarray, " M"]
    sample: Points  # the cloud in the scene's frame
    rgb: UInt8[np.ndarray, "N 3"] | None

    @property
    def report(self) -> dict[str, object]:
        """The result as ``alignment.json`` holds it."""
        matrix = np.vstack([self.scene_from_cloud.matrix, [0.0, 0.0, 0.0, 1.0]])
        return {
            "matrix": matrix.tolist(),
            "scale": self.scene_from_cloud.scale,
            "inlier_ratio": self.inlier_ratio,
            "median_residual": self.median_residual,
            "standard_error": self.error,
            "standard_error_degrees": self.rotation_error,
            "degrees_per_half_pixel": self.principal_point_sensitivity,
            "extent": self.extent,
            "brightness_correlation": self.brightness_correlation,
            "runner_up_inlier_ratio": self.runner_up,
        }

    @property
    def finding(self) -> Finding:
        """The result, as a warning if the rotation is uncertain."""
        uncertain = 2 * self.rotation_error > MAX_ROTATION_ERROR
        sensitive = self.principal_point_sensitivity > MAX_ROTATION_ERROR / 2
        text = (
            f"Aligned at scale {self.scene_from_cloud.scale:.6g}: {self.inlier_ratio:.0%} of the "
            f"scene's points lie on the cloud (median distance {self.median_residual:.3g}), "
            f"standard error {self.error:.2g} (scene units) and {self.rotation_error:.2g} degrees."
        )
        if uncertain:
            text += (
                f" Warning: the rotation may be off by more than {MAX_ROTATION_ERROR:g} degrees."
            )
        if sensitive:
            text += (
                " The photographs stand so close together that a principal point half a pixel off "
                f"would rotate the cloud by {self.principal_point_sensitivity:.2g} degrees."
            )
        return Finding("cloud-alignment", text, "warning" if uncertain or sensitive else "info")


def align_cloud(
    scene: Scene,
    paths: Sequence[Path],
    progress: Progress = silent,
    settings: AlignSettings = ALIGNMENT,
    columns: Sequence[str] = (),
) -> CloudAlignment:
    """Align clouds, all in one frame of any scale, with a scene that has points of its own.

    ``columns`` are those of text files, as of ``open_cloud``.

    Raises:
        PointCloudError: The scene or the cloud has too few points, or no alignment is reliable.
        SceneNotFoundError: A file is missing.
        SceneFormatError: A file is damaged.
    """
    tie_points = select_tie_points(scene)
    offset, xyz, rgb = sample_cloud(paths, progress, columns)
    progress("align", 0.0)
    unit_from_scene, unit_from_cloud = to_unit_size(tie_points.xyz), to_unit_size(xyz)
    unit_points = tie_points.transformed(unit_from_scene)
    surface = CloudSurface.of(unit_from_cloud.points(xyz))
    first, *others = _candidates(surface, unit_points.xyz, settings, progress)
    close = settings.inlier_distance
    refined = refine(surface, unit_points, first.cloud_from_scene, close)
    best = refined or first
    ratio = best.inlier_ratio(close)
    runner_up = next((other for other in others if _is_distinct(best, other, settings)), None)
    runner_up_ratio = runner_up.inlier_ratio(close) if runner_up else 0.0
    correlation = _brightness_correlation(best, surface, unit_points, rgb, close)
    if ratio < settings.min_inlier_ratio:
        raise _unreliable(
            f"at best {ratio:.0%} of the scene's points on the cloud: it shows another place, too "
            "little of this one, or its points are too sparse"
        )
    if runner_up is not None and runner_up_ratio > settings.max_runner_up * ratio:
        other = _brightness_correlation(runner_up, surface, unit_points, rgb, close)
        if (
            correlation is None
            or correlation <= settings.colors_agree
            or (other or 0.0) >= settings.colors_disagree
        ):
            raise _unreliable(
                f"several that fit nearly as well ({ratio:.0%} and {runner_up_ratio:.0%} of the "
                "scene's points on the cloud): the place looks alike from several sides, or is "
                "another"
            )
    if refined is None:
        raise _unreliable("one that is free to slide: the scene is nearly planar")
    if (error := _max_error(refined, unit_points.xyz)) > settings.max_error:
        raise _unreliable(
            f"one that is free to slide by {error:.2%} of the scene's extent: the scene is nearly "
            "planar"
        )
    # The offset in double precision, then to unit size.
    centred = Similarity(1.0, np.eye(3), -offset).then(unit_from_cloud)
    to_scene = centred.then(best.cloud_from_scene.inverse).then(unit_from_scene.inverse)
    extent, residuals = 1 / unit_from_scene.scale, best.residuals
    return CloudAlignment(
        to_scene, ratio, float(np.median(residuals[residuals < close])) * extent,
        error * extent, np.degrees(refined.rotation_error),
        np.degrees(float(np.linalg.norm(refined.sensitivity)) / 2), extent,
        correlation, runner_up_ratio, tie_points.xyz,
        residuals * extent, to_scene.points(xyz + offset), rgb,
    )  # fmt: skip


def _unreliable(found: str) -> PointCloudError:
    fix = "Pass `transform`, or cover more of the scene in both."
    return PointCloudError("one reliable alignment of the cloud", found=found, fix=fix)


def _candidates(
    surface: CloudSurface, tie_xyz: Points, settings: AlignSettings, progress: Progress
) -> list[SimilarityFit]:
    """Return distinct alignments, best first."""
    stages = settings.stages
    starts = find_starts(surface.xyz, tie_xyz, stages[0].candidates, progress, settings.search)
    for s, stage in enumerate(stages):
        sample = strided(tie_xyz, stage.tie_points)
        starts = starts[: stage.candidates]
        fitted: list[SimilarityFit] = []
        for i, start in enumerate(starts):
            with suppress(np.linalg.LinAlgError):
                alignment = fit(surface, sample, start, stage)
                if 0.3 < alignment.cloud_from_scene.scale < 3.0:
                    fitted.append(alignment)
            progress("align", (s + (i + 1) / len(starts)) / len(stages))
        fitted.sort(key=lambda alignment: -alignment.inlier_ratio(stage.inlier_distance))
        kept: list[SimilarityFit] = []
        for alignment in fitted:
            if all(_is_distinct(alignment, better, settings) for better in kept):
                kept.append(alignment)
        starts = [alignment.cloud_from_scene for alignment in kept]
    if not kept:
        raise _unreliable("no start from which the registration converges")
    return kept


def _is_distinct(first: SimilarityFit, second: SimilarityFit, settings: AlignSettings) -> bool:
    """Whether two alignments, of clouds at unit size, are not variants of one."""
    a, b = first.cloud_from_scene, second.cloud_from_scene
    cosine = (np.trace(a.rotation.T @ b.rotation) - 1) / 2
    degrees = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    log_scale = abs(np.log(a.scale / b.scale))
    shift = float(np.linalg.norm(a.translation - b.translation))
    return bool(
        degrees > settings.distinct_degrees
        or log_scale > settings.distinct_log_scale
        or shift > settings.distinct_shift
    )


def _brightness_correlation(
    alignment: SimilarityFit,
    surface: CloudSurface,
    tie_points: TiePoints,
    rgb: UInt8[np.ndarray, "N 3"] | None,
    inlier_distance: float,
) -> float | None:
    """Correlate the brightness of inliers and of their nearest cloud points; None if undefined."""
    inliers = alignment.residuals < inlier_distance
    few = np.count_nonzero(inliers) < MIN_TIE_POINTS // 2
    if rgb is None or tie_points.brightness.std() == 0 or few:
        return None
    idx = surface.tree.query(alignment.cloud_from_scene.points(tie_points.xyz[inliers]))[1]
    brightness = rgb[idx].astype(np.float64).mean(axis=1)
    if not brightness.std() > 0:
        return None
    return float(np.corrcoef(brightness, tie_points.brightness[inliers])[0, 1])


def _max_error(alignment: RefinedFit, tie_xyz: Points) -> float:
    """Return the standard error at the farthest corner of the tie points, in extents."""
    q = alignment.cloud_from_scene.points(np.percentile(tie_xyz, (2, 98), axis=0))
    corners = np.stack(np.meshgrid(*q.T, indexing="ij"), axis=-1).reshape(-1, 3) - alignment.center
    worst = 0.0
    for x, y, z in corners:
        cross = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])  # w x a = cross w
        J = np.column_stack([cross, np.eye(3), [x, y, z]])
        worst = max(worst, float(np.linalg.eigvalsh(J @ alignment.covariance @ J.T)[-1]))
    return float(np.sqrt(worst)) / alignment.cloud_from_scene.scale
