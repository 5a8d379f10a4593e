"""Aligning a cloud with a scene, or refusing to, with the reason. Nothing is random.

Notation: *marks* are the scene's own points; *extent* is their root mean square distance from
their median. The *share* is the fraction of marks within ``CLOSE`` extents of the cloud's surface.
A *rival* is another alignment, turned by more than ``TURNED`` degrees, scaled by more than
``SCALED`` or shifted by more than ``SHIFTED`` extents. The *error* is the standard error of the
alignment at the farthest corner of the marks: it is large where the cloud lets the scene slide.

Every orientation and shift is tried at several scales, with both clouds at root mean square size 1
around 0. A start takes a mark to the cloud's frame: x -> s R x + t. Its *reward* is the mean over
the marks of max(``FAR`` - d / s, 0), with d the distance to the cloud, in the scene's units:
otherwise shrinking all marks to one point would be best. For each rotation and scale the rewards of
all shifts are one correlation of the marks' histogram with the grid of these values, by Fourier
transforms. Then orientations around the best are tried. They are Alexa's super-Fibonacci spirals on
unit quaternions ("Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3)", CVPR 2022).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.fft import irfftn, rfftn
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from splatseed.errors import PointCloudError
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.seeding.clouds import icp
from splatseed.seeding.clouds.icp import Fitted, Marks, Points, Surface
from splatseed.seeding.clouds.voxels import sample_cloud
from splatseed.similarity import Similarity

ROUNDS = (
    (100, 250, 20, 0.3, 0.04, 0.04, 0.85),
    (16, 1500, 20, 0.2, 0.02, 0.02, 0.82),
    (4, icp.MOST_MARKS, 40, 0.04, 0.005, 0.01, 0.75),
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
SURE = 0.003  # greatest error, in extents
EXACT = 0.1  # degrees that the alignment should not be off by: a doubt that is greater is told


@dataclass(frozen=True, eq=False)
class CloudAlignment:
    """Where a cloud lies in a scene; lengths are in scene units."""

    scene_from_cloud: Similarity
    share: float
    residual: float  # median distance from the cloud, of the marks on it
    error: float  # standard, at the farthest corner
    turn: float  # standard error of the rotation, degrees
    principal_point_sensitivity: float  # degrees by which half a pixel would turn it
    extent: float
    likeness: float | None  # correlation of brightness of marks and cloud; None without colours
    rival: float  # share of the best rival; 0 without one
    marks: Points
    residuals: Float64[np.ndarray, " M"]
    sample: Points  # the cloud in the scene's frame
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
        """What was found, and what may be more wrong than ``EXACT``."""
        told = (
            f"Aligned at scale {self.scene_from_cloud.scale:.6g}: {self.share:.0%} of the scene's "
            f"points lie on the cloud, {self.residual:.3g} from it in the median, standard "
            f"error {self.error:.2g} (the scene's unit) and {self.turn:.2g} degrees."
        )
        if 2 * self.turn > EXACT:
            told += f" Warning: it may be turned by more than {EXACT:g} degrees."
        if self.principal_point_sensitivity > EXACT / 2:
            told += (
                " The photographs stand so close together that principal points half a pixel off "
                f"would turn it by {self.principal_point_sensitivity:.2g} degrees."
            )
        return told


def align(scene: Scene, paths: Sequence[Path], progress: Progress = silent) -> CloudAlignment:
    """Find where clouds, in one frame of any scale, lie in a scene with points of its own.

    Raises:
        PointCloudError: The scene or the cloud has too few points, or the alignment is not sure.
        SceneNotFoundError: A file is missing.
        SceneFormatError: One is damaged.
    """
    marks = icp.find_marks(scene)
    offset, xyz, rgb = sample_cloud(paths, progress)
    progress("align", 0.0)
    unit_of_marks, unit_of_cloud = to_unit_size(marks.xyz), to_unit_size(xyz)
    small, surface = marks.through(unit_of_marks), Surface.of(unit_of_cloud.points(xyz))
    first, *others = _candidates(surface, small.xyz, progress)
    polished = icp.polish(surface, small, first.cloud_from_scene, CLOSE)
    best = polished or first
    share = best.share(CLOSE)
    rival = next((each for each in others if _differs(best, each)), None)
    rival_share = rival.share(CLOSE) if rival else 0.0
    likeness = _likeness(best, surface, small, rgb)
    if share < SHARE:
        raise _unsure(
            f"at best {share:.0%} of the scene's points on the cloud: it is of another place, "
            "or shows too little of this one, or its points lie too far apart"
        )
    if rival is not None and rival_share > RIVAL * share:
        other = _likeness(rival, surface, small, rgb)
        if likeness is None or likeness <= LIKE or (other or 0.0) >= UNLIKE:  # colours do not tell
            raise _unsure(
                f"several that fit nearly as well ({share:.0%} and {rival_share:.0%} of the "
                "scene's points on the cloud): the place looks alike from several sides, or is "
                "another"
            )
    if polished is None:
        raise _unsure("one free to slide: the scene is nearly planar")
    if (error := _error(polished, small.xyz)) > SURE:
        raise _unsure(
            f"one free to slide by {error:.2%} of the scene's extent: the scene is nearly planar"
        )
    # The offset in double precision, then to unit size.
    centred = Similarity(1.0, np.eye(3), -offset).then(unit_of_cloud)
    to_scene = centred.then(best.cloud_from_scene.inverse).then(unit_of_marks.inverse)
    extent, residuals = 1 / unit_of_marks.scale, best.residuals
    return CloudAlignment(
        to_scene, share, float(np.median(residuals[residuals < CLOSE])) * extent,
        error * extent, np.degrees(polished.turn),
        np.degrees(float(np.linalg.norm(polished.sensitivity)) / 2), extent,
        likeness, rival_share, marks.xyz,
        residuals * extent, to_scene.points(xyz + offset), rgb,
    )  # fmt: skip


def _unsure(found: str) -> PointCloudError:
    fix = "Give the transform with --transform FILE, or cover more of the scene in both."
    return PointCloudError("one reliable alignment of the cloud", found=found, fix=fix)


def _candidates(surface: Surface, marks: Points, progress: Progress) -> list[Fitted]:
    """Alignments, best first, no two alike; refused if none holds."""
    waiting = find_starts(surface.xyz, marks, ROUNDS[0][0], progress)
    for stage, (num, count, rounds, far, least, close, shrink) in enumerate(ROUNDS):
        some = marks[:: -(-len(marks) // count)]
        candidates: list[Fitted] = []
        for i, start in enumerate(waiting[:num]):
            with suppress(np.linalg.LinAlgError):
                fitted = icp.fit(surface, some, start, far, rounds, least, shrink)
                if 0.3 < fitted.cloud_from_scene.scale < 3.0:
                    candidates.append(fitted)
            progress("align", (stage + (i + 1) / len(waiting[:num])) / len(ROUNDS))
        kept: list[Fitted] = []
        for each in sorted(candidates, key=lambda each: -each.share(close)):
            if all(_differs(each, other) for other in kept):
                kept.append(each)
        waiting = [each.cloud_from_scene for each in kept]
    if not kept:
        raise _unsure("no way to lay one on the other")
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
    fitted: Fitted, surface: Surface, marks: Marks, rgb: UInt8[np.ndarray, "N 3"] | None
) -> float | None:
    """Correlation of brightness between marks and their nearest cloud points."""
    on = fitted.residuals < CLOSE
    if rgb is None or marks.brightness.std() == 0 or np.count_nonzero(on) < icp.LEAST_MARKS // 2:
        return None
    idx = surface.tree.query(fitted.cloud_from_scene.points(marks.xyz[on]))[1]
    there = rgb[idx].astype(np.float64).mean(axis=1)
    return float(np.corrcoef(there, marks.brightness[on])[0, 1]) if there.std() > 0 else None


def _error(fitted: icp.Polished, marks: Points) -> float:
    """Standard error at the farthest corner of the marks, in their extents."""
    q = fitted.cloud_from_scene.points(np.percentile(marks, (2, 98), axis=0))
    corners = np.stack(np.meshgrid(*q.T, indexing="ij"), axis=-1).reshape(-1, 3) - fitted.center
    worst = 0.0
    for x, y, z in corners:
        cross = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])  # w x a = cross w
        J = np.column_stack([cross, np.eye(3), [x, y, z]])
        worst = max(worst, float(np.linalg.eigvalsh(J @ fitted.covariance @ J.T)[-1]))
    return float(np.sqrt(worst)) / fitted.cloud_from_scene.scale


ROTATIONS = 1200  # about 18 degrees from any orientation to the nearest
BEST, AROUND = 12, (-9.0, 0.0, 9.0)
"""Of how many orientations those around are tried, and by how many degrees about each axis."""
SCALES = (0.7, 0.84, 1.0, 1.19, 1.42)
EVEN = 0.1  # side of the cells of which each counts once, however many marks it holds
CELLS, HALF = 36, 2.7  # cells of the grid along each axis, and half its side
FAR = 0.3
INNER = 0.95


def to_unit_size(xyz: Points) -> Similarity:
    """From a cloud's own frame to unit size around 0; the farthest twentieth does not count."""
    center = np.median(xyz, axis=0)
    for _ in range(3):
        distance = np.linalg.norm(xyz - center, axis=1)
        inner = xyz[distance <= np.quantile(distance, INNER)]
        center = inner.mean(axis=0)
    extent = float(np.sqrt(np.mean(np.sum((inner - center) ** 2, axis=1))))
    return Similarity(1 / extent, np.eye(3), -center / extent)


def find_starts(
    cloud: Points, marks: Points, num: int, progress: Progress = silent
) -> list[Similarity]:
    """The ``num`` best starts, one for each orientation, of points at unit size."""
    side = 2 * HALF / CELLS
    place = np.floor((cloud + HALF) / side).astype(np.int64)
    empty = np.ones((CELLS,) * 3, np.bool_)
    empty[tuple(place[((place >= 0) & (place < CELLS)).all(axis=1)].T)] = False
    distances = np.asarray(distance_transform_edt(empty) * side, np.float32)
    fields = [rfftn(np.maximum(FAR - distances / scale, 0).astype(np.float32)) for scale in SCALES]
    # The first mark in each cell.
    first = np.unique(np.floor(marks / EVEN).astype(np.int64), axis=0, return_index=True)[1]
    some = marks[np.sort(first)]
    spread = spread_rotations(ROTATIONS)
    starts = _correlate(fields, some, spread, "try orientations", progress)
    turns = [turn for turn in product(AROUND, repeat=3) if any(turn)]
    small = Rotation.from_rotvec(np.radians(turns)).as_matrix()
    best = np.array([start.rotation for _, start in _best_first(starts)[:BEST]])
    around = np.asarray(best[:, None] @ small).reshape(-1, 3, 3)
    starts += _correlate(fields, some, around, "try those around the best", progress)
    return [start for _, start in _best_first(starts)[:num]]


def _best_first(starts: list[tuple[float, Similarity]]) -> list[tuple[float, Similarity]]:
    return sorted(starts, key=lambda each: -each[0])


def _correlate(
    fields: list[np.ndarray],
    marks: Points,
    rotations: Float64[np.ndarray, "n 3 3"],
    stage: str,
    progress: Progress,
) -> list[tuple[float, Similarity]]:
    """The reward of each rotation, with its best scale and shift."""
    shape, side = (CELLS,) * 3, 2 * HALF / CELLS
    starts = []
    for r, rotation in enumerate(rotations):
        turned, reward = marks @ rotation.T, -np.inf
        for s, field in zip(SCALES, fields, strict=True):
            cells = np.floor(s * turned / side).astype(np.int64) % CELLS
            flat = np.ravel_multi_index(tuple(cells.T), shape)
            counts = np.bincount(flat, minlength=CELLS**3).reshape(shape).astype(np.float32)
            rewards = irfftn(field * np.conj(rfftn(counts)), shape)
            if rewards.max() > reward:
                best = np.array(np.unravel_index(int(rewards.argmax()), shape))
                reward, scale, shift = float(rewards.max()), s, (best + 0.5) * side - HALF
        starts.append((reward, Similarity(scale, rotation, shift)))
        progress(stage, (r + 1) / len(rotations))
    return starts


def spread_rotations(num: int) -> Float64[np.ndarray, "n 3 3"]:
    """Rotations spread evenly over all orientations."""
    s = np.arange(num) + 0.5
    small, large = np.sqrt(s / num), np.sqrt(1 - s / num)
    alpha, beta = 2 * np.pi * s / np.sqrt(2.0), 2 * np.pi * s / 1.533751168755204288118041
    x, y = small * np.sin(alpha), small * np.cos(alpha)
    z, w = large * np.sin(beta), large * np.cos(beta)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0).copy()
