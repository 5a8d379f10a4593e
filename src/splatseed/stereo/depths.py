"""Depth maps from photographs alone: every view compared with a few others, then with their maps.

Notation: V views of a scene, of W x H pixels each; maps have a pixel for every block of g x g pixels. Promise: the
same scene, settings and seed give the same bytes, whatever the number of threads; a depth stands only where other
views' maps, found without it, agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt8

from splatseed.camera import Camera
from splatseed.progress import Progress, in_threads, silent
from splatseed.scene import Image
from splatseed.stereo.consistency import confirm
from splatseed.stereo.maps import StereoMap
from splatseed.stereo.patchmatch import Pictures, begin, sweep
from splatseed.stereo.quads import grey_image, make_quads
from splatseed.stereo.settings import StereoSettings
from splatseed.stereo.start import first_planes, inverse_depth_bounds
from splatseed.views.pairs import choose_sources
from splatseed.views.sightings import Sightings
from splatseed.views.view import View

__all__ = ["Stereo", "find_stereo", "other_from_view"]


@dataclass(frozen=True, eq=False)
class Stereo:
    """What stereo found.

    Args:
        views: The photographs at the size that was compared.
        planes: Of each view, float32 [3, h, w]: inverse depth and its slopes a pixel of the view.
        costs: Of each view, float32 [h, w].
        agreeing: Of each view, which of its witnesses confirm a pixel, a bit each, uint8 [h, w].
        sources: The views that each was compared with, best first, int64 [V, K]; -1 = none.
        settings: How.
    """

    views: tuple[View, ...]
    planes: list[Float32[np.ndarray, "3 h w"]]
    costs: list[Float32[np.ndarray, "h w"]]
    agreeing: list[UInt8[np.ndarray, "h w"]]
    sources: Int64[np.ndarray, "V K"]
    settings: StereoSettings

    def kept(self, i: int) -> np.ndarray:
        """Which pixels of view i have a depth that enough others confirm, bool [h, w]."""
        asked = int((self.sources[i] >= 0).sum())
        needed = max(1, min(self.settings.min_agreeing, asked))
        return np.asarray(np.bitwise_count(self.agreeing[i]) >= needed)

    def map(self, i: int) -> StereoMap:
        """What is known of view i."""
        view, kept = self.views[i], self.kept(i)
        height, width = kept.shape
        K = np.diag([1 / self.settings.grid, 1 / self.settings.grid, 1.0]) @ view.K
        depth = np.where(kept, 1.0 / self.planes[i][0], np.nan).astype(np.float32)
        normal = np.where(kept[..., None], self.normals(i), np.nan).astype(np.float32)
        names = tuple(self.views[j].name for j in self.sources[i] if j >= 0)
        camera = Camera(K, width, height, view.cam_from_world)
        agreeing = np.where(kept, self.agreeing[i], 0).astype(np.uint8)
        return StereoMap(view.name, camera, depth, normal, self.confidence(i), names, agreeing)

    def confidence(self, i: int) -> Float32[np.ndarray, "h w"]:
        """The correlation, and half as much doubt with each view that agrees; 0 where not kept."""
        likeness = np.clip(1.0 - self.costs[i], 0.0, 1.0)
        belief = 1.0 - 0.5 ** np.bitwise_count(self.agreeing[i])
        return np.where(self.kept(i), likeness * belief, 0.0).astype(np.float32)

    def normals(self, i: int) -> Float32[np.ndarray, "h w 3"]:
        """Unit normals towards the camera, in its axes.

        1 / z = m (u, v, 1) = (K' m) ray for the plane's m = (gx, gy, w0 - gx u0 - gy v0); the normal is
        along -K' m, as 1 / z > 0 along every ray.
        """
        w, gx, gy = self.planes[i].astype(np.float64)
        place = (np.indices(w.shape)[::-1] + 0.5) * self.settings.grid
        m = np.stack([gx, gy, w - gx * place[0] - gy * place[1]], axis=-1)
        normal = -m @ self.views[i].K
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True), np.float32)


def find_stereo(
    views: Sequence[View],
    images: Sequence[Image],
    sightings: Sightings,
    settings: StereoSettings,
    seed: int = 0,
    progress: Progress = silent,
) -> Stereo:
    """Compare photographs with each other.

    Args:
        views: The photographs at the size to compare.
        images: The images they are of, in the same order.
        sightings: The points that each image sees, which depth is looked for around.
        settings: How.
        seed: The same seed gives the same bytes.
        progress: Told how far it is.
    """
    seen = [sightings.rows_of(image) for image in images]
    centers = np.stack([image.camera.center for image in images])
    sources = choose_sources(seen, sightings.xyz, centers, settings.num_witnesses)
    found = _match_all(views, seen, sightings, sources, settings, seed, progress)
    planes, costs = [each[0] for each in found], [each[1] for each in found]
    agreeing = _confirm_all(views, planes, costs, sources, settings, progress)
    return Stereo(tuple(views), planes, costs, agreeing, sources, settings)


Found = tuple[Float32[np.ndarray, "3 h w"], Float32[np.ndarray, "h w"]]


def _match_all(
    views: Sequence[View],
    seen: Sequence[Int64[np.ndarray, " M"]],
    sightings: Sightings,
    sources: Int64[np.ndarray, "V K"],
    settings: StereoSettings,
    seed: int,
    progress: Progress,
) -> list[Found]:
    """Planes and costs of every view."""
    greys = [grey_image(view.image) for view in views]
    found: list[Found] = [None] * len(views)  # type: ignore[list-item]

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            others = sources[i][sources[i] >= 0][: settings.num_sources].tolist()
            found[i] = _match(i, others, views, greys, sightings.xyz[seen[i]], settings, seed)

    in_threads(work, len(views), 1, "compare photographs", progress)
    return found


def _match(
    i: int,
    others: Sequence[int],
    views: Sequence[View],
    greys: Sequence[UInt8[np.ndarray, "H W"]],
    xyz: Float64[np.ndarray, "M 3"],
    settings: StereoSettings,
    seed: int,
) -> Found:
    """The planes of one view."""
    view, grid = views[i], settings.grid
    shape = (view.height // grid, view.width // grid)
    planes, costs = np.full((3, *shape), np.nan, np.float32), np.full(shape, np.inf, np.float32)
    uv, w = _points_in(view, xyz)
    if not others or not len(w) or not costs.size:
        return planes, costs
    rng = np.random.default_rng([seed, i])
    bounds = inverse_depth_bounds(w)
    pictures = _pictures(
        view, greys[i], [views[j] for j in others], [greys[j] for j in others], grid, bounds
    )
    begin(pictures, first_planes(uv, w, bounds, shape, grid, rng), planes, costs)
    for number in range(settings.sweeps):
        for color in range(2):
            sweep(pictures, color, number, rng.integers(1 << 63, dtype=np.uint64), planes, costs)
    if view.mask is not None:
        costs[~_blocks_known(view.mask, grid)] = np.inf
    return planes, costs


def _blocks_known(mask: Bool[np.ndarray, "H W"], grid: int) -> Bool[np.ndarray, "h w"]:
    """Which blocks of grid x grid pixels have all of them in the photograph."""
    rows, columns = mask.shape[0] // grid, mask.shape[1] // grid
    blocks = mask[: rows * grid, : columns * grid].reshape(rows, grid, columns, grid)
    return np.asarray(blocks.all(axis=(1, 3)))


def _points_in(
    view: View, xyz: Float64[np.ndarray, "M 3"]
) -> tuple[Float64[np.ndarray, "M 2"], Float64[np.ndarray, " M"]]:
    """Pixels and inverse depths of the points in front of a view."""
    uv, z = Camera(view.K, view.width, view.height, view.cam_from_world).project(xyz)
    front = z > 0
    return uv[front], 1.0 / z[front]


def _pictures(
    view: View,
    grey: UInt8[np.ndarray, "H W"],
    others: Sequence[View],
    greys: Sequence[UInt8[np.ndarray, "H W"]],
    grid: int,
    bounds: Float32[np.ndarray, " 2"],
) -> Pictures:
    offsets = np.cumsum([0, *(each.size for each in greys)])
    sources: Int32[np.ndarray, " Q"] = np.empty(offsets[-1], np.int32)
    for start, stop, each in zip(offsets, offsets[1:], greys, strict=False):
        sources[start:stop] = make_quads(each).ravel()
    warps = [other_from_view(view, other) for other in others]
    packed = [np.concatenate([warp[:, :3].ravel(), warp[:, 3]]) for warp in warps]
    sizes = np.array([(other.width, other.height) for other in others], np.int64)
    return Pictures(
        make_quads(grey).ravel(), np.array([view.width, view.height], np.int64),
        sources, sizes, offsets, np.array(packed, np.float32), grid, float(view.K[0, 0]), bounds,
    )  # fmt: skip


def other_from_view(view: View, other: View) -> Float64[np.ndarray, "3 4"]:
    """Pixels (u, v, 1) of a view times depth, and 1, to those of another: K_s [R K_r^-1, t]."""
    relative = other.cam_from_world @ np.linalg.inv(view.cam_from_world)
    return np.asarray(
        other.K @ np.hstack([relative[:3, :3] @ np.linalg.inv(view.K), relative[:3, 3:]])
    )


def _confirm_all(
    views: Sequence[View],
    planes: Sequence[Float32[np.ndarray, "3 h w"]],
    costs: Sequence[Float32[np.ndarray, "h w"]],
    sources: Int64[np.ndarray, "V K"],
    settings: StereoSettings,
    progress: Progress,
) -> list[UInt8[np.ndarray, "h w"]]:
    """Which witnesses of each view confirm each of its pixels."""
    agreeing = [np.zeros(each.shape, np.uint8) for each in costs]

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            for bit, j in enumerate(sources[i].tolist()):
                if j >= 0:
                    confirm(
                        planes[i], costs[i], settings.max_cost, settings.grid,
                        other_from_view(views[i], views[j]), planes[j], costs[j],
                        settings.tolerance, np.uint8(1 << bit), agreeing[i],
                    )  # fmt: skip

    in_threads(work, len(views), 4, "compare depths", progress)
    return agreeing
