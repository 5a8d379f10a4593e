"""Aligning a cloud with a scene, or refusing to, with the reason.

Notation: *marks* are the scene's own points; *extent* is their root mean square distance from
their median. The *share* is the fraction of marks within ``CLOSE`` extents of the cloud's surface.
A *rival* is another alignment, turned by more than ``TURNED`` degrees, scaled by more than
``SCALED`` or shifted by more than ``SHIFTED`` extents. The *error* is the standard error of the
alignment at the farthest corner of the marks, whatever their variances: it is large where the cloud
lets the scene slide. It is that of the marks: a principal point that is off moves all of them at
once, and the *sensitivity* is how far half a pixel of it would turn the alignment.
Promise: an alignment is returned only if most marks lie on the cloud, no rival is nearly as good,
and the error is small; else the reason is told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.spatial import cKDTree

from splatseed.errors import PointCloudError
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.seeding.alignment.coarse import find_starts, to_unit_size
from splatseed.seeding.alignment.icp import Fitted, Surface, fit, polish
from splatseed.seeding.alignment.marks import LEAST_MARKS, MOST_MARKS, Marks, find_marks
from splatseed.seeding.clouds.voxels import normals_of, sample_cloud
from splatseed.similarity import Similarity

ROUNDS = (
    (100, 250, 20, 0.3, 0.04, 0.04, 0.85),
    (16, 1500, 20, 0.2, 0.02, 0.02, 0.82),
    (4, MOST_MARKS, 40, 0.04, 0.005, 0.01, 0.75),
)
"""Stages: alignments, marks, rounds of ICP, the first and the last reach, within how much of the
cloud marks count, in extents, and the factor of the reach from round to round. The first begins
with orientations that are off by 15 degrees and the second with some that still are by 10, so their
reach is wide and falls slowly."""
CLOSE = 0.01
SHARE = 0.5
"""Least share of marks on the cloud: 0.75 in a good one (room0), 0.33 of a handheld depth camera's
(red kitchen), where right and wrong alignments cannot be told apart."""
RIVAL = 0.7
"""A rival with this part of the best share is nearly as good. Among wrong alignments the best and
the next are always so."""
TURNED, SCALED, SHIFTED = 8.0, 0.08, 0.1
LIKE, UNLIKE = 0.5, 0.25
"""Correlations of colours at the marks that tell an alignment from its rival."""
SURE = 0.003
"""Greatest error, in extents."""
EXACT = 0.1
"""Degrees that the alignment should not be off by: a doubt that is greater is told."""
_FIX = "Give the transform with --transform FILE, or bring more of the scene in both."


@dataclass(frozen=True, eq=False)
class CloudAlignment:
    """Where a cloud lies in a scene.

    Args:
        scene_from_cloud: The transform.
        share: Of the marks, those on the cloud's surface.
        residual: Median distance of these from the surface, scene units.
        error: Standard error at the farthest corner, scene units.
        turn: Standard error of the rotation, degrees.
        principal_point_sensitivity: Degrees that it would be turned by were the principal points
            off by half a pixel.
        extent: Of the marks, scene units.
        likeness: Correlation of brightness between marks and cloud, -1 to 1; None without colours.
        rival: Share of the best rival; 0 without one.
        marks: The scene's points, float64 [M, 3].
        residuals: Of each mark, scene units, float64 [M].
        sample: The cloud in the scene's frame, float64 [N, 3].
        rgb: Its colours; None without.
    """

    scene_from_cloud: Similarity
    share: float
    residual: float
    error: float
    turn: float
    principal_point_sensitivity: float
    extent: float
    likeness: float | None
    rival: float
    marks: Float64[np.ndarray, "M 3"]
    residuals: Float64[np.ndarray, " M"]
    sample: Float64[np.ndarray, "N 3"]
    rgb: UInt8[np.ndarray, "N 3"] | None

    @property
    def report(self) -> dict[str, object]:
        """What was found, for a file."""
        matrix = np.vstack([self.scene_from_cloud.matrix, [0.0, 0.0, 0.0, 1.0]])
        return {
            "matrix": matrix.tolist(),
            "scale": self.scene_from_cloud.scale,
            "share_of_points_on_the_cloud": self.share,
            "median_residual": self.residual,
            "standard_error": self.error,
            "standard_error_degrees": self.turn,
            "degrees_by_half_a_pixel": self.principal_point_sensitivity,
            "extent": self.extent,
            "likeness_of_colours": self.likeness,
            "share_of_next_best": self.rival,
        }

    @property
    def sentence(self) -> str:
        """What was found, in a sentence."""
        return (
            f"Aligned at scale {self.scene_from_cloud.scale:.6g}: {self.share:.0%} of the scene's "
            f"points lie on the cloud, {self.residual:.3g} from it in the median, standard "
            f"error {self.error:.2g} (the scene's unit) and {self.turn:.2g} degrees."
            f"{self._doubts}"
        )

    @property
    def _doubts(self) -> str:
        """What may be more wrong than ``EXACT``, as further sentences."""
        doubts = ""
        if 2 * self.turn > EXACT:
            doubts += f" Warning: it may be turned by more than {EXACT:g} degrees."
        if self.principal_point_sensitivity > EXACT / 2:
            doubts += (
                " The photographs stand so close together that principal points half a pixel off "
                f"would turn it by {self.principal_point_sensitivity:.2g} degrees."
            )
        return doubts


@dataclass(frozen=True, eq=False)
class _Candidate:
    """An alignment that was refined, with its share of marks on the cloud."""

    fitted: Fitted
    share: float


def align(scene: Scene, paths: Sequence[Path], progress: Progress = silent) -> CloudAlignment:
    """Find where clouds lie in a scene.

    Args:
        scene: With points of its own.
        paths: Clouds in one frame, of any scale.
        progress: Told how far it is.

    Raises:
        PointCloudError: The scene or the cloud has too few points, or the alignment is not sure.
        SceneNotFoundError: A file is missing.
        SceneFormatError: One is damaged.
    """
    marks = find_marks(scene)
    sample = sample_cloud(paths, progress)
    progress("align", 0.0)
    unit_of_marks, unit_of_cloud = to_unit_size(marks.xyz), to_unit_size(sample.xyz)
    small, cloud = marks.through(unit_of_marks), unit_of_cloud.points(sample.xyz)
    tree = cKDTree(cloud, balanced_tree=False)
    surface = Surface(cloud, normals_of(cloud, tree), tree)
    first, *others = _candidates(surface, small.xyz, progress)
    best, sensitivity = _polished(surface, small, first)
    rival = next((each for each in others if _differs(best.fitted, each.fitted)), None)
    likeness = _likeness(best, surface, small, sample.rgb)
    if rival is not None and likeness is not None and likeness > LIKE:
        # Colours may tell the best from its rival.
        told = (_likeness(rival, surface, small, sample.rgb) or 0.0) < UNLIKE
    else:
        told = False
    error = _error(best.fitted, small.xyz)
    _check(best, None if told else rival, error)
    # The offset in double precision, then to unit size.
    centred = Similarity(1.0, np.eye(3), -sample.offset).then(unit_of_cloud)
    to_unit = centred.then(best.fitted.cloud_from_scene.inverse)
    to_scene = to_unit.then(unit_of_marks.inverse)
    extent, residuals = 1 / unit_of_marks.scale, best.fitted.residuals
    return CloudAlignment(
        to_scene, best.share, float(np.median(residuals[residuals < CLOSE])) * extent,
        error * extent, np.degrees(best.fitted.turn), np.degrees(sensitivity), extent,
        likeness, rival.share if rival else 0.0, marks.xyz,
        residuals * extent, to_scene.points(sample.xyz + sample.offset), sample.rgb,
    )  # fmt: skip


def _candidates(
    surface: Surface,
    marks: Float64[np.ndarray, "M 3"],
    progress: Progress,
) -> list[_Candidate]:
    """Alignments, best first; refused if none holds."""
    starts = find_starts(surface.xyz, marks, ROUNDS[0][0], progress)
    rows = zip(starts.scale, starts.rotation, starts.shift, strict=True)
    waiting = [Similarity(float(scale), rotation, shift) for scale, rotation, shift in rows]
    candidates: list[_Candidate] = []
    for stage, (num, count, rounds, far, least, close, shrink) in enumerate(ROUNDS):
        some = marks[:: -(-len(marks) // count)]
        candidates = []
        for i, start in enumerate(waiting[:num]):
            fitted = fit(surface, some, start, far, rounds, least, shrink)
            if fitted is not None and 0.3 < fitted.cloud_from_scene.scale < 3.0:
                candidates.append(_Candidate(fitted, float(np.mean(fitted.residuals < close))))
            progress("align", (stage + (i + 1) / len(waiting[:num])) / len(ROUNDS))
        candidates = _different(sorted(candidates, key=lambda each: -each.share))
        waiting = [each.fitted.cloud_from_scene for each in candidates]
    if not candidates:
        raise _unsure("no way to lay one on the other")
    return candidates


def _polished(surface: Surface, marks: Marks, candidate: _Candidate) -> tuple[_Candidate, float]:
    """A candidate after the last stage, or as it was, and its sensitivity in radians."""
    polished = polish(surface, marks, candidate.fitted.cloud_from_scene, CLOSE)
    if polished is None:
        return candidate, 0.0
    share = float(np.mean(polished.fitted.residuals < CLOSE))
    return _Candidate(polished.fitted, share), float(np.linalg.norm(polished.sensitivity)) / 2


def _different(candidates: list[_Candidate]) -> list[_Candidate]:
    """The best of each group of like alignments."""
    kept: list[_Candidate] = []
    for each in candidates:
        if all(_differs(each.fitted, other.fitted) for other in kept):
            kept.append(each)
    return kept


def _differs(first: Fitted, second: Fitted) -> bool:
    """Whether two alignments, of unit clouds, are rivals."""
    a, b = first.cloud_from_scene, second.cloud_from_scene
    cosine = (np.trace(a.rotation.T @ b.rotation) - 1) / 2
    turned = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    scaled = abs(np.log(a.scale / b.scale))
    shifted = float(np.linalg.norm(a.translation - b.translation))
    return bool(turned > TURNED or scaled > SCALED or shifted > SHIFTED)


def _likeness(
    candidate: _Candidate,
    surface: Surface,
    marks: Marks,
    rgb: UInt8[np.ndarray, "N 3"] | None,
) -> float | None:
    """Correlation of brightness between marks and their nearest cloud points."""
    if rgb is None or marks.brightness.std() == 0:
        return None
    on = candidate.fitted.residuals < CLOSE
    if np.count_nonzero(on) < LEAST_MARKS // 2:
        return None
    idx = surface.tree.query(candidate.fitted.cloud_from_scene.points(marks.xyz[on]))[1]
    there = rgb[idx].astype(np.float64).mean(axis=1)
    return float(np.corrcoef(there, marks.brightness[on])[0, 1]) if there.std() > 0 else None


def _error(fitted: Fitted, marks: Float64[np.ndarray, "M 3"]) -> float:
    """Standard error at the farthest corner of the marks, in their extents."""
    q = fitted.cloud_from_scene.points(np.percentile(marks, (2, 98), axis=0))
    corners = np.stack(np.meshgrid(*q.T, indexing="ij"), axis=-1).reshape(-1, 3) - fitted.center
    worst = 0.0
    for corner in corners:
        cross = np.array(
            [[0, corner[2], -corner[1]], [-corner[2], 0, corner[0]], [corner[1], -corner[0], 0]]
        )  # w x a = cross w
        J = np.column_stack([cross, np.eye(3), corner])
        worst = max(worst, float(np.linalg.eigvalsh(J @ fitted.covariance @ J.T)[-1]))
    return float(np.sqrt(worst)) / fitted.cloud_from_scene.scale


def _check(best: _Candidate, rival: _Candidate | None, error: float) -> None:
    """Refuse an alignment of too few marks, with a rival nearly as good, or one that slides."""
    if best.share < SHARE:
        raise _unsure(
            f"at best {best.share:.0%} of the scene's points on the cloud: it is of another place, "
            "or shows too little of this one, or its points lie too far apart"
        )
    if rival is not None and rival.share > RIVAL * best.share:
        raise _unsure(
            f"several that fit nearly as well ({best.share:.0%} and {rival.share:.0%} of the "
            "scene's points on the cloud): the place looks alike from several sides, or is another"
        )
    if error > SURE:
        raise _unsure(
            f"it free to slide by {error:.2%} of the scene's extent: there is little but one plane"
        )


def _unsure(found: str) -> PointCloudError:
    return PointCloudError("one alignment of the cloud that is sure", found=found, fix=_FIX)
