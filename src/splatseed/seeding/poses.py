"""Scenes that have poses and no points: are the poses sound, how exact are they, where to begin.

A *look* compares a photograph and its best partners, ``SIDE`` pixels wide, over every depth; its
*share* is that of the pixels whose depth others confirm. A *turn* undoes a usual mistake in writing
poses. Masked pixels count nowhere. A scene is refused only if its photographs agree by chance at
most, or clearly better after a turn. What lies across an epipolar line is the poses' fault: a
*corner* of view i is looked for in a band along its line in view j, turned into i's orientation
first, so that a point at inverse depth w moves from pixel p to ``K (K^-1 p + w c)``, c the step;
the *miss* is how far beside the line it is found, where one place is clearly most alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter, sobel, uniform_filter
from scipy.signal import correlate

from splatseed.camera import Camera
from splatseed.depth.stereo.coarse import prior_from_baseline
from splatseed.depth.stereo.maps import StereoSettings
from splatseed.depth.stereo.matching import match_views, valid_blocks
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.photos.sources import choose_by_pose
from splatseed.photos.view import View, data_factor, load_views
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene
from splatseed.text import quoted

Gray = Float64[np.ndarray, "H W"]
Pixel = Float64[np.ndarray, " 2"]

CORNERS_SIDE = 400  # longer side of the photographs that are compared, in pixels
CORNERS_LOOKS, CORNERS_PARTNERS = 5, 2
"""Photographs looked at, and those that each is compared with."""
CORNERS, APART = 100, 9  # corners of a photograph, at most; and pixels between them, at least
HALF = 5  # a patch is 2 HALF + 1 pixels wide
REACH = 24  # largest miss that is looked for, in pixels
FARTHEST = 0.3  # a band's length: what a point moves at most, in widths of a photograph
ALIKE, CLEARLY_BEST = 0.85, 0.1
"""Least correlation of a corner's best place, and by how much it is above any other."""
LEAST_FOUND = 8  # corners of a pair that must be found for it to count
LEAST_PAIRS = 1 / 3
"""Share of the pairs that must count; at sound poses of eight captures six of ten and more do."""
BY_CHANCE = 10.0
"""A median of so many pixels may be chance: misses found by chance are spread over ``REACH``."""
MOST_MISSED = 0.5
"""Pixels at stereo's size up to which poses are exact. COLMAP's are 0.1 to 0.5 on eight captures;
at 0.55, a tenth of a degree of noise, fern keeps 0.6 of its depths (benchmarks/stereo)."""


@dataclass(frozen=True)
class PoseError:
    """By how much photographs miss each other."""

    px: float  # median over pairs, in pixels at the size at which stereo compares
    degrees: float  # the turn of a camera that moves its picture as far
    exact: bool  # whether it is half a pixel at most
    side: int  # longer side of that size

    def __str__(self) -> str:
        return f"{self.px:.2g} px ({self.degrees:.2g} degrees) at {self.side:,} px a side"

    @property
    def warning(self) -> str:
        """What to do about it, in a sentence; empty if the poses are exact."""
        if self.exact:
            return ""
        return (
            f"The photographs are misaligned by about {self}, the size at which they are compared, "
            f"and at most {MOST_MISSED:g} px is exact: --refine-poses may fix that."
        )


def pose_error(
    scene: Scene, images: Sequence[Image], progress: Progress = silent
) -> PoseError | None:
    """Measure how exact the poses of two photographs or more are, in a few seconds, without points.

    None if too few corners are found again, as on plain walls or at poses that are far off.

    Raises:
        SceneFormatError: A photograph cannot be used.
    """
    poses = np.array([image.camera.cam_from_world for image in images])
    partners = choose_by_pose(poses, CORNERS_PARTNERS)
    factor = data_factor(images, CORNERS_SIDE)
    looked = np.unique(np.linspace(0, len(images) - 1, CORNERS_LOOKS).round().astype(int)).tolist()
    misses, pairs = [], 0
    for number, i in enumerate(looked):
        some = [images[i], *(images[j] for j in partners[i].tolist() if j >= 0)]
        view, *rest = load_views(scene, some, data_factor=factor, undistort=True)
        pairs += len(rest)
        for other in rest:
            found = np.abs(_misses(view, other))
            if len(found) >= LEAST_FOUND:
                miss = float(np.median(found))
                misses.append((miss, np.degrees(np.arctan(miss / view.K[0, 0]))))
        progress("measure poses", (number + 1) / len(looked))
    if len(misses) < max(1.0, LEAST_PAIRS * pairs):
        return None
    px, degrees = np.median(misses, axis=0).tolist()
    if px > BY_CHANCE:
        return None
    compared = data_factor(images, StereoSettings.max_size)
    px *= factor / compared
    longest = max(max(image.camera.width, image.camera.height) for image in images)
    return PoseError(px, degrees, round(px, 2) <= MOST_MISSED, longest // compared)


def _misses(view: View, other: View) -> Float64[np.ndarray, " M"]:
    """How far beside their epipolar lines the corners of a view are found, in pixels."""
    j_from_i = other.cam_from_world @ np.linalg.inv(view.cam_from_world)
    margin = int(FARTHEST * view.width) + REACH + 2 * HALF
    image = _gray(view)
    turned = _turned(_gray(other), other.K @ j_from_i[:3, :3] @ np.linalg.inv(view.K), view, margin)
    # c: the step in i's axes, as R d + w t = R (d + w R' t).
    step = view.K @ (j_from_i[:3, :3].T @ j_from_i[:3, 3])
    found = []
    for p in _corners(image, view.mask):
        # d/dw of K (K^-1 p + w c), at w = 0: where a far point begins to move.
        along = step[:2] - step[2] * p
        length = np.linalg.norm(along)
        if length >= 1e-9 * max(1.0, abs(step[2])):
            miss = _miss(image, turned, p, along / length, margin, FARTHEST * view.width)
            found += [] if miss is None else [miss]
    return np.array(found)


def _gray(view: View) -> Gray:
    return np.asarray(view.photograph.mean(axis=2))


def _turned(image: Gray, turn: Float64[np.ndarray, "3 3"], view: View, margin: int) -> Gray:
    """A photograph in the view's orientation, with a margin; NaN where it shows nothing."""
    rows, columns = view.height + 2 * margin, view.width + 2 * margin
    v, u = np.indices((rows, columns)) - margin + 0.5
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ turn.T
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    return _values(image, *np.where(rays[..., 2] <= 0, -1.0, [x - 0.5, y - 0.5]))


def _values(image: Gray, x: np.ndarray, y: np.ndarray) -> Gray:
    """Bilinear values at places, the centre of the first pixel at 0; NaN outside."""
    return np.asarray(map_coordinates(image, [y, x], order=1, cval=np.nan))


def _corners(image: Gray, mask: Bool[np.ndarray, "H W"] | None) -> Float64[np.ndarray, "N 2"]:
    """Pixels (column, row) around which a photograph changes most in every direction.

    Masked ones are left out: a turntable's background does not turn with it.
    """
    x, y = sobel(image, axis=1), sobel(image, axis=0)
    xx, xy, yy = (gaussian_filter(each, 2.0) for each in (x * x, x * y, y * y))
    # The smaller eigenvalue of the structure tensor.
    least = 0.5 * (xx + yy - np.hypot(xx - yy, 2 * xy))
    peaks = (least == maximum_filter(least, APART)) & (least > 0)
    if mask is not None:
        peaks &= mask
    row, column = np.nonzero(peaks)
    best = np.argsort(-least[peaks], kind="stable")[:CORNERS]
    return np.stack([column[best], row[best]], axis=1) + 0.5


def _miss(
    image: Gray, turned: Gray, p: Pixel, along: Pixel, margin: int, farthest: float
) -> float | None:
    """How far beside its line a corner is found; None unless one place is clearly best."""
    patch = _sample(image, p, along, (-HALF, HALF), HALF)
    if not np.isfinite(patch).all():  # beyond the picture's border
        return None
    # a little backwards, too: with wrong poses a far point may seem to be behind infinity.
    length = -HALF - REACH, HALF + int(farthest)
    scores = _correlation(patch, _sample(turned, p + margin, along, length, HALF + REACH))
    at = np.unravel_index(np.argmax(scores), scores.shape)
    best, (column, row) = scores[at], at
    rest = scores.copy()
    rest[max(column - HALF, 0) : column + HALF + 1, max(row - HALF, 0) : row + HALF + 1] = -1.0
    inside = 0 < row < scores.shape[1] - 1
    if best < ALIKE or best - rest.max() < CLEARLY_BEST or not inside:
        return None
    before, after = scores[column, row - 1], scores[column, row + 1]
    # The peak of a parabola through three correlations.
    bend = 2 * best - before - after
    return float(row - REACH + (0.5 * (after - before) / bend if bend > 0 else 0.0))


def _sample(image: Gray, p: Pixel, along: Pixel, length: tuple[int, int], width: int) -> Gray:
    """Values on a grid along a line through p, and to both sides of it; NaN outside."""
    a = np.arange(length[0], length[1] + 1)[:, None]
    b = np.arange(-width, width + 1)[None]
    x = p[0] - 0.5 + a * along[0] - b * along[1]
    return _values(image, x, p[1] - 0.5 + a * along[1] + b * along[0])


def _correlation(patch: Gray, band: Gray) -> Gray:
    """The normalised correlation of a patch at each place of a band; -1 where unknown."""
    known = np.isfinite(band)
    filled = np.where(known, band, 0.0)
    one = patch - patch.mean()
    # sum (b - mean b) a = sum b a, as the sum of a is 0.
    product = correlate(filled, one, mode="valid", method="fft")
    inner = (slice(HALF, -HALF), slice(HALF, -HALF))
    mean, square, share = (
        uniform_filter(each, 2 * HALF + 1)[inner]
        for each in (filled, filled * filled, known.astype(np.float64))
    )
    spread = np.sqrt(np.maximum(square - mean * mean, 1e-6) * patch.size)
    return np.where(share > 1 - 1e-9, product / (spread * np.linalg.norm(one)), -1.0)


Poses = Float64[np.ndarray, "V 4 4"]

SIDE, PARTNERS = 200, 5  # size of the photographs of a look, and views that each is compared with
SETTINGS = StereoSettings(grid=4, sweeps=6, tolerance=0.03, max_cost=0.4)
LOOKS = 3  # photographs looked at, while what is seen decides nothing
ENOUGH = 0.3  # share at which nothing else is tried; wrong poses reached 0.17
CLEARLY = 2.0  # a share so many times another is clearly above it
LEAST = 0.1  # least share after a turn at which the turn is believed
NIL = 0.03
"""Share that photographs of eleven captures reached by chance, with their poses exchanged; with
their own, the hardest reached 0.07."""
LOW = 0.15
"""Share below which few points are to be expected: bare rooms and corridors have 0.08 and 0.09 in
the mean, seven other captures 0.26 and more."""
MOST_SEEN = 24  # photographs whose pictures are searched for any overlap

_YZ, _XY = np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])
TURNS: Mapping[str, Callable[[Poses], Poses]] = MappingProxyType(
    {
        "the y and z axes of every camera are negated": lambda poses: _YZ @ poses,
        "the x and y axes of every camera are negated": lambda poses: _XY @ poses,
        "every pose is inverted": np.linalg.inv,
        "every pose is inverted and its camera's y and z axes are negated": (
            lambda poses: _YZ @ np.linalg.inv(poses)
        ),
    }
)
OPENCV = "with OpenCV's camera axes (x right, y down, z forward)"
WRITTEN = {
    "colmap": f"the model's images hold cam_from_world, {OPENCV}",
    "llff": "poses_bounds.npy holds world_from_cam, with camera axes down, right, back",
    "rgbd": f"its trajectory holds world_from_cam, {OPENCV}",
    "transforms": "each transform_matrix is world_from_cam, with OpenGL's camera axes (x right, "
    "y up, z back)",
}
"""What each format's poses are."""


def check_poses(scene: Scene, images: Sequence[Image], progress: Progress = silent) -> float:
    """Refuse photographs that cannot be compared at their poses, within seconds, without points.

    Returns:
        The mean share of pixels whose depth other photographs confirm, of those looked at.

    Raises:
        SceneNotFoundError: There are fewer than two.
        SceneFormatError: All cameras are in one place, no two photographs show the same, they agree
            nowhere, or clearly better if poses are read otherwise; or one cannot be used.
    """
    poses = np.array([image.camera.cam_from_world for image in images])
    _check_places(poses)
    assert scene.source is not None  # noqa: S101  (it has photographs)
    agreeing = f"photographs that agree at the poses of {scene.source.root}"
    shares: list[float] = []
    for number in range(LOOKS):
        progress("check poses", number / LOOKS)
        shares.append(_look(scene, images, poses, number))
        if shares[-1] >= ENOUGH:
            break
        turned = {how: _look(scene, images, turn(poses), number) for how, turn in TURNS.items()}
        best = max(turned, key=lambda how: turned[how])
        if turned[best] >= max(CLEARLY * shares[-1], LEAST):
            found = f"a depth that others confirm at {shares[-1]:.1%} of their pixels"
            raise SceneFormatError(
                agreeing,
                found=f"{found}, and at {turned[best]:.0%} once {best}",
                fix=f"Write the poses so: {WRITTEN[scene.source.format]}.",
            )
        if shares[-1] > max(CLEARLY * turned[best], NIL):
            # They are sound; how well they agree, one photograph does not tell.
            shares += [_look(scene, images, poses, more) for more in range(number + 1, LOOKS)]
            break
    else:
        if (share := float(np.mean(shares))) <= NIL:
            new = f"splatseed sfm {quoted(scene.source.image_dir or 'IMAGES')} -o SCENE"
            if not _any_overlap([image.camera for image in images]):
                raise SceneFormatError(
                    f"photographs that show the same places, at the poses of {scene.source.root}",
                    found=f"no two of {len(images)} whose pictures overlap at any depth",
                    fix=f"Take more photographs in between, or find the poses anew: {new}.",
                )
            error = pose_error(scene, images)
            off = error is not None and not error.exact
            missed = f"; they miss each other by about {error}" if off else ""
            check = "Check that poses and names of the images belong together"
            check = "Mend the poses with --refine-poses" if off else check
            raise SceneFormatError(
                agreeing,
                found=f"a depth that others confirm at {share:.1%} of their pixels{missed}",
                fix=f"{check}, or find poses anew: {new}.",
            )
    progress("check poses", 1.0)
    return float(np.mean(shares))


def low_agreement(share: float, masked: float = 0.0) -> str:
    """What a low share of ``check_poses`` means and what helps, in a sentence; empty if it is not.

    ``masked`` is the share of the pixels that masks leave out.
    """
    if share >= LOW:
        return ""
    few = f" masks that leave {1 - masked:.0%} of the pixels," if masked >= 0.5 else ""
    return (
        f"The photographs agree on the depth of only {share:.0%} of the pixels that count, so "
        f"method auto will find few points; likely reasons are{few} light that changes between "
        "photographs, bare or shiny surfaces, or photographs far apart: take more from closer "
        "together in constant light, or triangulate points (splatseed sfm --poses-from)."
    )


def _check_places(poses: Poses) -> None:
    """Refuse cameras that are alone, or all in one place."""
    if len(poses) < 2:
        raise SceneNotFoundError(
            "at least two photographs with a pose, as the scene has no points",
            found=f"{len(poses)}",
            fix="Add photographs: depth comes from comparing them. Views held out do not count.",
        )
    centers = np.linalg.inv(poses)[:, :3, 3]
    apart = np.abs(centers - centers[0]).max()
    if apart <= np.finfo(np.float32).eps * np.abs(centers).max():
        raise SceneFormatError(
            "photographs from different places, as the scene has no points",
            found=f"all {len(poses)} cameras in one place, as in a panorama",
            fix="Take photographs while moving: cameras that only turn show no depth.",
        )


def _look(scene: Scene, images: Sequence[Image], poses: Poses, number: int) -> float:
    """The share of a photograph and its partners at these poses, of the pixels that count."""
    first = (2 * number + 1) * len(images) // (2 * LOOKS)
    partners = choose_by_pose(poses, PARTNERS)[first]
    chosen = [first, *partners[partners >= 0].tolist()]
    some = [images[i] for i in chosen]
    read = load_views(scene, some, data_factor=data_factor(some, SIDE), undistort=True)
    views = [replace(view, cam_from_world=poses[i]) for view, i in zip(read, chosen, strict=True)]
    sources = choose_by_pose(poses[chosen], PARTNERS)
    priors = [prior_from_baseline(views, i, others) for i, others in enumerate(sources)]
    stereo = match_views(views, priors, sources, SETTINGS, 0, silent)
    shares = []
    for i, view in enumerate(views):
        kept = stereo.confirmed(i)
        counts = None if view.mask is None else valid_blocks(view.mask, SETTINGS.grid)
        shares += [kept.mean()] if counts is None else [kept[counts].mean()] * bool(counts.any())
    return float(np.mean(shares)) if shares else 0.0


def _any_overlap(cameras: Sequence[Camera]) -> bool:
    """Whether a point at some depth before one camera falls into another's picture."""
    uv = (np.indices((4, 5)).reshape(2, -1).T[:, ::-1] + 0.5) / [5, 4]
    for first in cameras[:: -(-len(cameras) // MOST_SEEN)]:
        for other in cameras:
            if gap := float(np.linalg.norm(first.center - other.center)):
                z = gap * np.repeat(np.geomspace(0.1, 1000.0, 12), len(uv))
                xyz = first.unproject(np.tile(uv * [first.width, first.height], (12, 1)), z)
                seen = other.project(xyz)[0]  # NaN behind the camera
                if ((seen >= 0) & (seen < [other.width, other.height])).all(axis=1).any():
                    return True
    return False


def random_start(
    scene: Scene, rng: np.random.Generator, trainer: Literal["gsplat", "nerfstudio"] = "gsplat"
) -> PointCloud:
    """Points as a trainer draws them for a scene that has none, uniform in position and colour.

    By gsplat 1.5.3's simple_trainer (``init_type`` random), 100,000 in a cube that reaches 3.3
    times as far as the cameras, two at least; by nerfstudio 1.1.5's splatfacto, 50,000 that reach 5
    times as far as their coordinates.
    """
    centers = np.stack([image.camera.center for image in scene.images])
    middle, num = centers.mean(axis=0), 50_000
    half = 5.0 * np.abs(centers - middle).max()
    if trainer == "gsplat":
        # Its world is centred at the median, over cameras, of the point on the optical axis that is
        # nearest to the origin. It is turned, too, which a median of coordinates feels a little.
        axes = np.stack([image.camera.cam_from_world[2, :3] for image in scene.images])
        nearest = centers - (centers * axes).sum(axis=1, keepdims=True) * axes
        half = 3.0 * 1.1 * np.linalg.norm(centers - middle, axis=1).max()
        middle, num = np.median(nearest, axis=0), 100_000
    xyz = middle + half * rng.uniform(-1.0, 1.0, (num, 3))
    return PointCloud(xyz.astype(np.float32), rng.integers(0, 256, (num, 3), dtype=np.uint8))
