"""Margins: what lies just past the edges of the photographs, continued from what they show.

No photograph trains what it does not see, so that a model ends in black at their frames. After the
last step each training view is rendered, and its colours and inverse depths are continued beyond
its frame, the smoother the farther out. A Gaussian is added for every few pixels there, unless it
lies within another frame, or nearer to it. Promise: what is within a frame is left alone but for
Gaussians that reach across its edge; the same model gives the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64

from splatseed.camera import Camera
from splatseed.photos.view import NO_PIXELS, View
from splatseed.progress import Progress, silent
from splatseed.projection import scaled
from splatseed.splat.gaussians import SH_C0, Gaussians
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.training_frame import TrainingFrame
from splatseed.training.settings import TrainSettings

SIDE, FULL_SIZE = 512, 24
"""Longer side, about, at which views are rendered, in pixels, and the number of views from which on
it shrinks."""
WIDTH = 0.4
"""Width of the margin on each side, in longer sides of the frame."""
STEP = 4
"""Minimum distance of Gaussians, in pixels of the rendered view."""
SHARE = 0.025
"""Maximum number of Gaussians of margins, as a fraction of the cap: a tenth shows no more."""
SIZE = 0.7  # standard deviation of a Gaussian, in steps
REACH = 2.5  # standard deviations at which a Gaussian ends: so far it stays away from each frame
OPACITY = 0.9
FAR = 0.1
"""Margins are at least as far as what this share of a view's pixels shows or lies beyond: nearer
ones hang in the air, before what other cameras see."""
NEAR = 0.1
"""Nor is a Gaussian nearer to a camera than what this share of that camera's pixels shows: to a
camera beside that one, it would hide everything."""


def has_margins(settings: TrainSettings, views: Sequence[View]) -> bool:
    """Whether the model of a run on these views gets margins.

    Not where the number of Gaussians stays, of 3DGS as published, of a run that continues one, or
    of objects cut out.
    """
    cut_out = any(view.empty is not None or view.opacity is not None for view in views)
    grows = settings.traits.number_grows and not settings.as_3dgs and settings.start is None
    return grows and not cut_out


def with_room(settings: TrainSettings) -> TrainSettings:
    """Return settings whose cap leaves room for the margins."""
    cap = settings.cap
    return settings if cap is None else replace(settings, cap_max=max(2, round((1 - SHARE) * cap)))


def with_margins(
    model: Gaussians,
    frame: TrainingFrame,
    views: Sequence[View],
    cap: int | None,
    device: torch.device | None = None,
    progress: Progress = silent,
) -> Gaussians:
    """Add the margins of the training views to a model; both are in the scene's frame.

    They are at most ``SHARE`` of the ``cap``, or of the model without one; with one the faintest
    Gaussians make room if they have to.
    """
    limit = max(1.0, SHARE * (len(model) if cap is None else cap))
    renderer = ModelRenderer(model, frame, device)
    # Many views are rendered smaller, so that all continuations fit into memory.
    side, step = SIDE / max(1.0, math.sqrt(len(views) / FULL_SIZE)), STEP
    small, depths, values = [_reduced(view, side) for view in views], [], []
    for i, view in enumerate(small):
        depths.append(renderer.depth(view))
        values.append(_continued(renderer.color(view), depths[i]))
        progress("margins", 0.5 * (i + 1) / len(small))
    near = [float(np.quantile(d[d > 0], NEAR)) if (d > 0).any() else 0.0 for d in depths]
    done, left = 0.5, 1  # the share of the work, and passes after this one: at first a guess
    while True:
        parts = []
        for i in range(len(small)):
            parts.append(_margin(i, small, near, values[i], step))
            progress("margins", done + (1 - done) * (i + 1) / len(small) / (1 + left))
        xyz, colors, sizes = (np.concatenate(each) for each in zip(*parts, strict=True))
        if len(xyz) <= limit:
            break
        done += (1 - done) / (1 + left)
        left = _passes_left(len(xyz), limit, step)  # one more, as it is an estimate
        step = _wider(step)
    progress("margins", 1.0)
    if cap is not None and len(model) + len(xyz) > cap:
        order = np.argsort(-model.opacities, kind="stable")[: cap - len(xyz)]
        model = model.select(np.sort(order))
    added = {
        "means": xyz,
        "scales": np.repeat(np.log(sizes)[:, None], 3, axis=1),
        "quats": np.tile([1.0, 0.0, 0.0, 0.0], (len(xyz), 1)),
        "opacities": np.full(len(xyz), np.log(OPACITY / (1 - OPACITY))),
        "sh0": ((colors - 0.5) / SH_C0)[:, None],
        "shN": np.zeros((len(xyz), *model.shN.shape[1:])),
    }
    grown = {
        name: np.concatenate([array, added[name].astype(np.float32)])
        for name, array in model.arrays().items()
    }
    return Gaussians(**grown, antialiased=model.antialiased)


def _wider(step: int) -> int:
    return step + max(1, step // 8)


def _passes_left(count: int, limit: float, step: int) -> int:
    """Estimate how many passes until the limit is met: numbers in rings fall as 1 / step."""
    wider, passes = step, 0
    while count * step > limit * wider:
        wider, passes = _wider(wider), passes + 1
    return passes


def _reduced(view: View, side: float) -> View:
    factor = max(1, round(max(view.width, view.height) / side))
    width, height = view.width // factor, view.height // factor
    camera = Camera(scaled(view.K, 1 / factor), width, height, view.cam_from_world)
    return View(view.name, NO_PIXELS, camera, near=view.near)


def _continued(
    color: Float32[np.ndarray, "H W 3"], depth: Float32[np.ndarray, "H W"]
) -> Float32[np.ndarray, "h w 4"]:
    """Return colours and inverse depths of a view and of a margin around it."""
    around = _width(depth.shape)
    known = np.pad(depth > 0, around)
    inverse = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0)
    values = np.concatenate([color, inverse[..., None]], axis=2)
    values = np.pad(values.astype(np.float32), ((around, around), (around, around), (0, 0)))
    if not known.any():
        return values
    far = np.quantile(values[known, 3], FAR)
    filled = continued(values, known)
    filled[..., 3] = np.where(known, filled[..., 3], np.minimum(filled[..., 3], far))
    return np.asarray(filled, np.float32)


def _width(shape: tuple[int, ...]) -> int:
    return round(WIDTH * max(shape))


def _margin(
    i: int,
    views: Sequence[View],
    near: Sequence[float],
    values: Float32[np.ndarray, "h w 4"],
    step: int,
) -> tuple[Float64[np.ndarray, "M 3"], Float64[np.ndarray, "M 3"], Float64[np.ndarray, " M"]]:
    """Return positions, colours and sizes of the Gaussians beyond the frame of view i.

    They lie in rings around it, each with twice the size and the distance of the one within.
    """
    camera = views[i].camera
    around = _width((camera.height, camera.width))
    places, steps = [np.empty((0, 2), np.int64)], [np.empty(0, np.int64)]
    while (gap := REACH * SIZE * step) < around:
        row, column = np.mgrid[step // 2 : len(values) : step, step // 2 : values.shape[1] : step]
        pixels = np.stack([column.ravel(), row.ravel()], axis=1)
        beyond = _beyond(pixels + 0.5 - around, camera)
        places.append(pixels[(beyond > gap) & (beyond <= 2 * gap)])
        steps.append(np.full(len(places[-1]), step))
        step *= 2
    pixels = np.concatenate(places)
    continuation = values[pixels[:, 1], pixels[:, 0]]
    colors, inverse = continuation[:, :3], continuation[:, 3]
    used = inverse > 0
    uv, z = pixels[used] + 0.5 - around, 1.0 / inverse[used]
    xyz, sizes = camera.unproject(uv, z), SIZE * np.concatenate(steps)[used] * z / camera.K[0, 0]
    kept = _unseen(xyz, sizes, i, views)
    for view, clearance in zip(views, near, strict=True):
        kept &= np.linalg.norm(xyz - view.camera.center, axis=1) >= clearance
    return xyz[kept], colors[used][kept], sizes[kept]


def _unseen(
    xyz: Float64[np.ndarray, "M 3"], sizes: Float64[np.ndarray, " M"], i: int, views: Sequence[View]
) -> Bool[np.ndarray, " M"]:
    """Select Gaussians that reach into no other frame, and are nearest to that of view i."""
    kept = np.ones(len(xyz), bool)
    own = _beyond(views[i].camera.project(xyz)[0], views[i].camera)
    for j, other in enumerate(views):
        if j != i:
            uv, z = other.camera.project(xyz)
            reach = REACH * sizes * other.camera.K[0, 0]  # in pixels, times z
            distance = _beyond(uv, other.camera)
            kept &= (z <= 0) | ((distance * z > reach) & (distance >= own))
    return kept


def _beyond(uv: Float[np.ndarray, "M 2"], camera: Camera) -> Float64[np.ndarray, " M"]:
    """Return how far pixels lie outside a frame, in its pixels; below 0 within it."""
    return np.asarray(np.maximum(-uv, uv - [camera.width, camera.height]).max(axis=1))


def continued(
    values: Float64[np.ndarray, "H W C"], known: Bool[np.ndarray, "H W"]
) -> Float64[np.ndarray, "H W C"]:
    """Fill unknown pixels from the means of ever larger blocks of known ones, interpolated.

    Source: pull-push, S. J. Gortler et al., The Lumigraph (1996). At least one pixel is known.
    """
    if known.all():
        return values
    height, width, count = values.shape
    padding = (0, height % 2), (0, width % 2)
    counts = np.pad(known, padding).astype(np.float64)
    weighted = np.pad(values * known[..., None], (*padding, (0, 0)))
    rows, columns = counts.shape[0] // 2, counts.shape[1] // 2
    number = counts.reshape(rows, 2, columns, 2).sum(axis=(1, 3))
    total = weighted.reshape(rows, 2, columns, 2, count).sum(axis=(1, 3))
    means = total / np.maximum(number, 1.0)[..., None]
    coarse = continued(means, number > 0)
    lower, upper, part = zip(
        *(_between(length, size) for length, size in ((height, rows), (width, columns))),
        strict=True,
    )
    across = part[1][None, :, None]
    above, below = (
        coarse[row][:, lower[1]] * (1 - across) + coarse[row][:, upper[1]] * across
        for row in (lower[0], upper[0])
    )
    down = part[0][:, None, None]
    return np.where(known[..., None], values, above * (1 - down) + below * down)


def _between(length: int, size: int) -> tuple[np.ndarray, np.ndarray, Float64[np.ndarray, " L"]]:
    """Return the blocks, of two pixels, between whose centres pixels lie, and where."""
    place = np.clip((np.arange(length) + 0.5) / 2 - 0.5, 0, size - 1)
    lower = place.astype(np.int64)
    return lower, np.minimum(lower + 1, size - 1), place - lower
