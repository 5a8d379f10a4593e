"""verify: interpolated points compared with the photographs, then moved or dropped.

Notation: n originals, M new points; the *base* of a new point is its nearest original, and h, the
mean distance of the base to its 6 nearest, its spacing. The normal is the last principal axis of
the base and its 16 nearest. Up to two *reference views* judge a point: those that see its base, and
in whose frame, and in those of two of their sources (of the only one, if there is no more), it lies
well within; the closer and the more frontal a view, the better it sees the point. In each, the
point slides along its normal to where the photographs agree best, at a cost of one minus
correlation; the better view counts.

A point of one view, seen at pixel (u, v), slides with the plane through it: inverse depth w and its
slopes gx, gy per pixel (``stereo.cost``). Moving the plane by t spacings h along its normal n,
where n X is its distance from the camera, multiplies all three by 1 / (1 + t h / (n X)); the point
then lies where the plane meets the ray of (u, v), so that its window in the view stays the same.
Of the t, the one with the smallest (cost(t) + FLOOR) (1 + t^2) wins: a clearly low cost may move a
point, small differences between high costs may not.
Promise: the order of points stays; a point's surroundings and reference views depend on that point,
the originals, poses and visibility, not on other points; the same input gives the same bytes,
whatever the number of threads; points that no photograph can judge are kept and reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatseed.depth.stereo._kernels.cost import NOISE, SAMPLES, best_cost, prepare_window
from splatseed.depth.stereo.quads import grey_image, make_quad_images
from splatseed.methods.contract import NewPoints
from splatseed.methods.neighbors import Neighbors, PreparedCloud, prepare
from splatseed.methods.patches import local_frames
from splatseed.photos._kernels import project_point
from splatseed.photos.sources import choose_sources, views_of_points
from splatseed.photos.view import View
from splatseed.photos.visibility import Visibility
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, in_threads, silent
from splatseed.runtime.jit import always_inline, inline, kernel, parallel_range
from splatseed.runtime.simd import LANES
from splatseed.scene import Image

NEIGHBORS = 16  # neighbours that determine a normal, as for mls
FLAT = 0.4
"""A neighbourhood counts as flat up to this ratio of thickness to width; noise alone has about
0.7."""
BLOCK = 1 << 13


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The surroundings of M new points."""

    base: Int64[np.ndarray, " M"]  # row of the nearest original
    spacing: Float64[np.ndarray, " M"]  # h
    normals: Float64[np.ndarray, "M 3"]  # unit, of either sign; NaN where originals are collinear
    flat: Bool[np.ndarray, " M"]  # whether the originals there are coplanar


def survey(
    originals: Float64[np.ndarray, "n 3"],
    xyz: Float32[np.ndarray, "M 3"],
    progress: Progress = silent,
) -> Surroundings:
    """The surroundings of each new point, from at least 2 distinct finite originals."""
    nothing = np.zeros((len(originals), 3), np.uint8)
    cloud = prepare(PointCloud(originals.astype(np.float32), nothing), progress=progress)
    neighbors = cloud.neighbors(NEIGHBORS)
    frames, collinear = local_frames(cloud.xyz, neighbors.idx)
    flat = _thickness(cloud, neighbors, frames, progress) <= FLAT
    rank = _nearest(cloud, xyz, progress)
    # The tree numbers points in file order, neighbours are stored by row.
    row_of_rank = np.argsort(cloud.rank)
    row = row_of_rank[rank]
    normals = np.where(collinear[row, None], np.nan, frames[row, 2])
    return Surroundings(rank, neighbors.spacing[row], normals, (flat & ~collinear)[row])


def _thickness(
    cloud: PreparedCloud,
    neighbors: Neighbors,
    frames: Float64[np.ndarray, "n 3 3"],
    progress: Progress,
) -> Float64[np.ndarray, " n"]:
    """Extent of each neighbourhood along the normal, relative to the second axis."""
    thickness = np.empty(len(cloud))

    def work(start: int, stop: int) -> None:
        near = cloud.xyz[neighbors.idx[start:stop]] - cloud.xyz[start:stop, None]
        # The base itself, at the origin.
        near = np.concatenate([near, np.zeros((stop - start, 1, 3))], axis=1)
        spread = (near @ frames[start:stop, 1:].swapaxes(1, 2)).std(axis=1)
        thickness[start:stop] = spread[:, 1] / np.maximum(spread[:, 0], np.finfo(float).tiny)

    in_threads(work, len(cloud), BLOCK, "look at the originals", progress)
    return thickness


def _nearest(
    cloud: PreparedCloud, xyz: Float32[np.ndarray, "M 3"], progress: Progress
) -> Int64[np.ndarray, " M"]:
    """The original nearest to each point."""
    nearest = np.empty(len(xyz), np.int64)

    def work(start: int, stop: int) -> None:
        nearest[start:stop] = cloud.tree.query(xyz[start:stop] - cloud.center)[1]

    in_threads(work, len(xyz), BLOCK, "find the nearest originals", progress)
    return nearest


REFERENCE_VIEWS = 2
"""Views that judge a point; the better verdict counts, as one of them may not see it after all."""
WITNESSES = 2  # sources that must contain a point: this many determine its cost
MARGIN = 5.0  # pixels between a point and the frame: the window around it lies inside
OBLIQUE = 0.3  # weight of closeness for a surface seen edge on: normals are uncertain


def choose_reference_views(
    xyz: Float32[np.ndarray, "M 3"],
    around: Surroundings,
    views: Sequence[View],
    seen: Sequence[Int64[np.ndarray, " N"]],
    num_originals: int,
    sources: Int64[np.ndarray, "V K"],
) -> Int64[np.ndarray, "M J"]:
    """The views that judge each point, best first; -1 for none.

    ``seen`` are the originals that each view sees, ``sources`` the views it is compared with.
    """
    order, offsets = views_of_points(seen, num_originals)
    poses = np.stack([view.cam_from_world for view in views])
    matrices = np.stack([view.K @ view.cam_from_world[:3] for view in views])
    centers = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    sizes = np.array([(view.width, view.height) for view in views], np.float64)
    focals = np.array([view.K[0, 0] for view in views])
    judges = np.full((len(xyz), REFERENCE_VIEWS), -1)
    normals = np.nan_to_num(around.normals)
    _choose_views(
        xyz, around.base, normals, order, offsets, matrices, sizes, centers, focals,
        sources, judges,
    )  # fmt: skip
    return judges


@kernel
def _choose_views(  # type: ignore[no-untyped-def]  # Numba's types
    xyz, base, normals, order, offsets, matrices, sizes, centers, focals, sources, judges
):
    """The best views of each point."""
    for i in parallel_range(len(xyz)):
        worth = np.zeros(REFERENCE_VIEWS)
        for t in range(offsets[base[i]], offsets[base[i] + 1]):
            view = order[t]
            if not _holds(matrices[view], sizes[view], xyz[i]):
                continue
            if not _has_witnesses(xyz[i], sources[view], matrices, sizes):
                continue
            # Pixels per unit of length at the point, weighted by the angle.
            value = focals[view] * _sight(xyz[i], normals[i], centers[view])
            # Insertion into a sorted list of two.
            for k in range(REFERENCE_VIEWS):
                if value > worth[k]:
                    for after in range(REFERENCE_VIEWS - 1, k, -1):
                        worth[after], judges[i, after] = worth[after - 1], judges[i, after - 1]
                    worth[k], judges[i, k] = value, view
                    break


@inline
def _has_witnesses(point, sources, matrices, sizes):  # type: ignore[no-untyped-def]  # Numba's types
    """Whether enough of a view's sources contain a point."""
    asked, holding = 0, 0
    for other in sources:
        if other >= 0:
            asked += 1
            holding += _holds(matrices[other], sizes[other], point)
    return holding > 0 and holding >= min(asked, WITNESSES)


@inline
def _holds(matrix, size, point):  # type: ignore[no-untyped-def]  # Numba's types
    """Whether a point lies in front of a camera and well within its frame."""
    u, v, z = project_point(point, matrix)
    inside = MARGIN <= u <= size[0] - MARGIN and MARGIN <= v <= size[1] - MARGIN
    return z > 0.0 and inside


@inline
def _sight(point, normal, center):  # type: ignore[no-untyped-def]  # Numba's types
    """How well a surface is seen: (cos of the angle to its normal + OBLIQUE) / distance."""
    dot, squared = 0.0, 0.0
    for axis in range(3):
        ray = point[axis] - center[axis]
        dot += ray * normal[axis]
        squared += ray * ray
    distance = np.sqrt(squared)
    return (abs(dot) / distance + OBLIQUE) / distance


REACH = 1.5  # how far a point may move, in spacings
OFFSETS = 13  # number of offsets tried first, evenly spaced
REFINEMENTS = 4
"""Refinement steps: half a step to both sides of the best is tried, then the step is halved."""
FLOOR = 0.02  # cost of two photographs of one surface: anything lower is chance

_FLOOR, _NOISE, _ONE = (np.float32(each) for each in (FLOOR, NOISE, 1.0))


@inline
def slide(quad_images, uv, planes, reach, moves, costs, variances):  # type: ignore[no-untyped-def]  # Numba\'s types
    """The best offset of each point.

    Args:
        quad_images: ``stereo.patchmatch.QuadImages``; its grid and bounds are not used.
        uv: Pixels of the points, float32 [M, 2].
        planes: w, gx, gy through each, float32 [M, 3].
        reach: h / (n X), float32 [M], magnitude below 1 / REACH.
        moves: Filled with t, float32 [M].
        costs: Filled with the cost there, float32 [M].
        variances: Filled with the variance of the grey levels around the pixel, float32 [M].
    """
    places, window = np.zeros((2, LANES), np.float32), np.zeros((2, SAMPLES * LANES), np.float32)
    own, tried = np.zeros((4, LANES), np.float32), np.zeros(3 * LANES, np.float32)
    # Rows: t to try, cost, best value, its t, its cost, the t that half steps start from.
    state = np.zeros((6, LANES), np.float32)
    for first in range(0, len(uv), LANES):
        _fill_lanes(first, uv, planes, reach, places, own, state)
        prepare_window(
            quad_images.quads, quad_images.size[0], quad_images.size[1], places[0], places[1],
            window[0], window[1],
        )  # fmt: skip
        _search(quad_images, places, window, own, tried, state)
        for lane in range(min(LANES, len(uv) - first)):
            moves[first + lane], costs[first + lane] = state[3, lane], state[4, lane]
            variances[first + lane] = _variance(window, lane)


@inline
def _fill_lanes(first, uv, planes, reach, places, own, state):  # type: ignore[no-untyped-def]  # Numba\'s types
    """Sixteen points; beyond the end, the last one again."""
    for lane in range(LANES):
        i = min(first + lane, len(uv) - 1)
        places[0, lane], places[1, lane] = uv[i, 0], uv[i, 1]
        own[0, lane], own[1, lane], own[2, lane] = planes[i, 0], planes[i, 1], planes[i, 2]
        own[3, lane] = reach[i]
        state[2, lane] = np.inf


@inline
def _search(quad_images, places, window, own, tried, state):  # type: ignore[no-untyped-def]  # Numba\'s types
    """Try evenly spaced offsets, then ever closer ones around the best."""
    # 13 offsets from -1.5 to 1.5 spacings, a quarter apart; then 1/8, 1/16, 1/32 and 1/64.
    step = np.float32(2.0 * REACH / (OFFSETS - 1))
    for k in range(OFFSETS):
        state[0, :] = step * np.float32(k - OFFSETS // 2)
        _try(quad_images, places, window, own, tried, state)
    for _ in range(REFINEMENTS):
        step *= np.float32(0.5)
        state[5, :] = state[3, :]
        for side in range(2):
            state[0, :] = state[5, :] + (step if side else -step)
            _try(quad_images, places, window, own, tried, state)


@inline
def _try(quad_images, places, window, own, tried, state):  # type: ignore[no-untyped-def]  # Numba\'s types
    """Accept the offsets tried where they are better."""
    for lane in range(LANES):
        # w(t) = w / (1 + t h / (n X)), and likewise its slopes
        scale = _ONE / (_ONE + state[0, lane] * own[3, lane])
        for part in range(3):
            tried[part * LANES + lane] = scale * own[part, lane]
    best_cost(
        quad_images.sources, quad_images.sizes, quad_images.offsets, quad_images.warps,
        places[0], places[1], tried, window[0], window[1], state[1],
    )  # fmt: skip
    for lane in range(LANES):
        t, cost = state[0, lane], state[1, lane]
        # (cost(t) + FLOOR) (1 + t^2): far moves must pay off.
        value = (cost + _FLOOR) * (_ONE + t * t)
        if value < state[2, lane]:
            state[2, lane], state[3, lane], state[4, lane] = value, t, cost


@always_inline
def _variance(window, lane):  # type: ignore[no-untyped-def]  # Numba\'s types
    """Variance of a reference window, from its weights c and samples a (``stereo.cost``)."""
    # sum a^2 / c = var / (var + NOISE)
    share = np.float32(0.0)
    for k in range(SAMPLES):
        a = window[1, k * LANES + lane]
        share += a * a / window[0, k * LANES + lane]
    # Solved for var; a share of 1 would be infinite variance.
    return _NOISE * share / max(_ONE - share, np.float32(1e-6))


NUM_SOURCES = 5  # views that a judge is compared with
MAX_COST = 0.4  # a point whose lowest cost is higher fits nowhere
TEXTURE = 4.0  # variance of grey levels around a pixel below which there is nothing to compare
BARE_CONFIDENCE = 0.1  # confidence of points on flat untextured surfaces, which stay in place
STEEPEST = 0.3
"""Smallest cosine between ray and normal; steeper normals are taken to be wrong and turned to
this."""
LARGEST_MOVE = 0.3
"""Largest move of a plane along its normal, in spacings, as a fraction of its distance from the
camera."""
MOVED = 0.25  # spacings from which on a point is reported as moved


@dataclass(frozen=True, eq=False)
class _Trials:
    """The verdicts of the judges of M points; infinite cost where there is no judge."""

    xyz: Float32[np.ndarray, "M J 3"]  # the best position
    moves: Float32[np.ndarray, "M J"]  # its offset from the point along the normal, in spacings
    costs: Float32[np.ndarray, "M J"]  # one minus correlation there
    variances: Float32[np.ndarray, "M J"]  # of the grey levels around the judge's pixel


def verify(
    views: Sequence[View],
    images: Sequence[Image],
    visibility: Visibility,
    new: NewPoints,
    progress: Progress = silent,
) -> NewPoints:
    """Compare interpolated points with the photographs.

    A point stays, moved by up to 1.5 spacings along its normal, if the photographs agree there; its
    confidence is their correlation. It stays in place, with ``BARE_CONFIDENCE``, on a flat surface
    without texture, and with unknown confidence (NaN) if fewer than two photographs see it. All
    others are dropped.

    The views are at the size to compare, the images theirs; ``visibility`` tells who sees the
    originals that the points were made from. Those that stay have normals, too (towards the judge;
    NaN where the originals are collinear), and notes on how many were dropped and why.
    """
    if len(visibility.xyz) < 2 or not len(new.xyz) or not views:
        return _unchecked(new)
    seen = [visibility.rows_of(image) for image in images]
    poses = np.stack([view.cam_from_world for view in views])
    centers = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    sources = choose_sources(seen, visibility.xyz, centers, NUM_SOURCES)
    around = survey(visibility.xyz, new.xyz, progress)
    judges = choose_reference_views(new.xyz, around, views, seen, len(visibility.xyz), sources)
    trials = _try_all(new.xyz, around, views, judges, sources, progress)
    return _decide(new, around, trials, centers[judges])


def _try_all(
    xyz: Float32[np.ndarray, "M 3"],
    around: Surroundings,
    views: Sequence[View],
    judges: Int64[np.ndarray, "M J"],
    sources: Int64[np.ndarray, "V K"],
    progress: Progress,
) -> _Trials:
    """Let every view judge its points."""
    greys = [grey_image(view.photograph) for view in views]
    trials = _no_trials(*judges.shape)
    # The trials of each view side by side; -1, no judge, sorts before all.
    order = np.argsort(judges, axis=None, kind="stable")
    starts = np.searchsorted(judges.ravel()[order], np.arange(len(views) + 1))

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            mine = order[starts[i] : starts[i + 1]]
            others = sources[i][sources[i] >= 0].tolist()
            if len(mine):
                _judge(i, others, views, greys, xyz, around, mine, trials)

    in_threads(work, len(views), 1, "hold points against photographs", progress)
    return trials


def _no_trials(num: int, judges: int) -> _Trials:
    shape = (num, judges)
    return _Trials(
        np.zeros((*shape, 3), np.float32),
        np.zeros(shape, np.float32),
        np.full(shape, np.inf, np.float32),
        np.zeros(shape, np.float32),
    )


def _judge(
    i: int,
    others: Sequence[int],
    views: Sequence[View],
    greys: Sequence[UInt8[np.ndarray, "H W"]],
    xyz: Float32[np.ndarray, "M 3"],
    around: Surroundings,
    mine: Int64[np.ndarray, " T"],
    trials: _Trials,
) -> None:
    """Let view i judge its points; ``mine`` indexes the trials, judge by judge within each."""
    view, (point, judge) = views[i], np.unravel_index(mine, trials.costs.shape)
    world = xyz[point].astype(np.float64)
    uv, planes, reach = _planes(view, world, around.normals[point], around.spacing[point])
    moves, costs, variances = (np.empty(len(mine), np.float32) for _ in range(3))
    # No bounds on inverse depth: the slide itself is bounded.
    anything = np.array([0.0, np.inf], np.float32)
    quad_images = make_quad_images(
        view, greys[i], [views[j] for j in others], [greys[j] for j in others], 1, anything
    )
    slide(quad_images, uv, planes, reach, moves, costs, variances)
    if view.mask is not None:
        column, row = uv.astype(np.int64).T
        costs[~view.mask[row, column]] = np.inf
    rotation, translation = view.cam_from_world[:3, :3], view.cam_from_world[:3, 3]
    center = -rotation.T @ translation
    # The plane at w / (1 + t h / (n X)) meets the ray 1 + t h / (n X) times as far from the camera.
    trials.xyz[point, judge] = center + (1.0 + moves * reach)[:, None] * (world - center)
    trials.moves[point, judge], trials.costs[point, judge] = moves, costs
    trials.variances[point, judge] = variances


def _planes(
    view: View,
    xyz: Float64[np.ndarray, "T 3"],
    normals: Float64[np.ndarray, "T 3"],
    spacing: Float64[np.ndarray, " T"],
) -> tuple[Float32[np.ndarray, "T 2"], Float32[np.ndarray, "T 3"], Float32[np.ndarray, " T"]]:
    """Pixels of points, planes through them (w, gx, gy), and h / (n X), as ``slide`` has them."""
    rotation, translation = view.cam_from_world[:3, :3], view.cam_from_world[:3, 3]
    cam = xyz @ rotation.T + translation
    n = _facing(normals @ rotation.T, cam)
    distance = np.einsum("ij,ij->i", n, cam)  # negative, as n faces the camera
    uv = (cam @ view.K.T)[:, :2] / cam[:, 2:]
    # n K^-1 (u, v, 1) w^-1 = n X, so w is linear in u and v with the slopes of n K^-1 / (n X)
    slopes = (n @ np.linalg.inv(view.K))[:, :2] / distance[:, None]
    planes = np.column_stack([1.0 / cam[:, 2], slopes])
    # Negative, as n X is: t > 0 moves along the normal, towards the camera.
    reach = np.maximum(spacing / distance, -LARGEST_MOVE)
    return uv.astype(np.float32), planes.astype(np.float32), reach.astype(np.float32)


def _facing(
    normals: Float64[np.ndarray, "T 3"], cam: Float64[np.ndarray, "T 3"]
) -> Float64[np.ndarray, "T 3"]:
    """Normals in camera axes, turned towards the camera by ``STEEPEST`` at least, or if unknown."""
    back = -cam / np.linalg.norm(cam, axis=1, keepdims=True)
    n = np.where(np.isnan(normals), back, normals)
    cosine = np.einsum("ij,ij->i", n, back)[:, None]
    n, cosine = np.where(cosine < 0, -n, n), np.abs(cosine)
    # Tilted just far enough: cos of the angle to the ray becomes STEEPEST.
    across = n - cosine * back
    length = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(float).tiny)
    leaning = STEEPEST * back + np.sqrt(1.0 - STEEPEST**2) * across / length
    return np.asarray(np.where(cosine < STEEPEST, leaning, n))


def _decide(
    new: NewPoints, around: Surroundings, trials: _Trials, centers: Float64[np.ndarray, "M J 3"]
) -> NewPoints:
    """Keep, move and drop points by their judges' verdicts; ``centers`` are the judges' centres."""
    judged, textured = np.isfinite(trials.costs), trials.variances >= TEXTURE
    # Where there is no texture a low cost is chance.
    costs = np.where(textured, trials.costs, np.inf)
    rows, best = np.arange(len(costs)), costs.argmin(axis=1)
    agrees = costs[rows, best] <= MAX_COST
    unknown = ~judged.any(axis=1)
    # Interpolation is safe where nothing can be compared but the originals are coplanar.
    bare = ~unknown & ~(judged & textured).any(axis=1) & around.flat
    # 1 - cost is the correlation.
    confidence = np.where(agrees, 1.0 - np.maximum(costs[rows, best], 0.0), np.nan)
    confidence[bare] = BARE_CONFIDENCE
    xyz = np.where(agrees[:, None], trials.xyz[rows, best], new.xyz)
    # Principal axes have no sign: the normal is turned towards the judge.
    outward = np.einsum("ij,ij->i", around.normals, centers[rows, best] - new.xyz)
    normals = np.where((outward < 0)[:, None] & ~unknown[:, None], -1.0, 1.0) * around.normals
    changed = new._replace(
        xyz=xyz.astype(np.float32),
        normals=normals.astype(np.float32),
        confidence=confidence.astype(np.float32),
    )
    moved = agrees & (np.abs(trials.moves[rows, best]) >= MOVED)
    return _select(changed, agrees | bare | unknown, _notes(agrees, moved, bare, unknown))


def _select(new: NewPoints, kept: Bool[np.ndarray, " M"], notes: tuple[str, ...]) -> NewPoints:
    """Some of the points, with notes."""
    arrays = {
        name: array[kept] for name, array in new._asdict().items() if isinstance(array, np.ndarray)
    }
    return new._replace(**arrays, notes=(*new.notes, *notes))


def _notes(
    agrees: Bool[np.ndarray, " M"],
    moved: Bool[np.ndarray, " M"],
    bare: Bool[np.ndarray, " M"],
    unknown: Bool[np.ndarray, " M"],
) -> tuple[str, ...]:
    """How many points met which fate, one sentence each."""
    dropped = ~(agrees | bare | unknown)
    fates = (
        (moved, "of them do so only after a move of more than a quarter of their spacing"),
        (dropped, "agree nowhere and were dropped"),
        (bare, "lie on flat surfaces without texture and were kept in place, at low confidence"),
        (unknown, "are seen by fewer than two photographs and were kept unchecked"),
    )
    first = f"{agrees.sum():,} of {len(agrees):,} new points agree with the photographs."
    return (first, *(f"{which.sum():,} {fate}." for which, fate in fates if which.any()))


def _unchecked(new: NewPoints) -> NewPoints:
    """The points unchanged, if there is nothing to compare them with."""
    num = len(new.xyz)
    unknown = np.full(num, np.nan, np.float32)
    note = f"{num:,} new points could not be compared with photographs and were kept unchecked."
    changed = new._replace(normals=np.full((num, 3), np.nan, np.float32), confidence=unknown)
    return changed._replace(notes=(*new.notes, note)) if num else changed
