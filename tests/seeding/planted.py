"""A textured plane before a few cameras, and new points beside it: where each belongs is known.

Notation: the plane goes through the world's origin, ``NORMAL`` towards the cameras; N originals lie
on it in rows and columns, ``STEP`` metres apart. New points carry their numbers in their colours,
so that what is left can be told.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from splatseed.camera import Intrinsics, quat_from_rotation
from splatseed.scene import Image
from splatseed.seeding.verify import verify
from splatseed.synthetic.room import Room, render_view
from splatseed.upsample.method import NewPoints
from splatseed.views.view import View
from splatseed.views.visibility import Visibility

from ..depth.stereo.made import DOWN, STONE, arc, tilted_plane

STEP = 0.12
ALONG = np.array([np.cos(np.pi / 6), 0.0, np.sin(np.pi / 6)])
NORMAL = np.array([ALONG[2], 0.0, -ALONG[0]])


def photographs() -> list[View]:
    """Five views of the plane, 96 x 80."""
    surfaces = tilted_plane(30.0)
    room = Room(("plane",), surfaces, (STONE,))
    return [
        View(f"{k}", render_view(room, c)[0], c.K, c.width, c.height, c.cam_from_world)
        for k, c in enumerate(arc())
    ]


def constant(view: View, level: int = 128) -> View:
    """The same view of nothing but one grey."""
    return dataclasses.replace(view, photograph=np.full_like(view.photograph, level))


def on_plane(places: np.ndarray) -> np.ndarray:
    """World positions of places in the plane, [N, 2] to [N, 3]."""
    return places[:, :1] * ALONG + places[:, 1:] * DOWN


def originals(side: int = 11) -> np.ndarray:
    """Rows and columns of points about the origin, [N, 3]."""
    step = STEP * (np.arange(side) - side // 2)
    return on_plane(np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2))


def spacings(known: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    """Mean distance of each point's nearest original to the six nearest to that, [M]."""
    apart = np.linalg.norm(known[:, None] - known, axis=2)
    base = np.linalg.norm(xyz[:, None] - known, axis=2).argmin(axis=1)
    return np.sort(apart, axis=1)[base, 1:7].mean(axis=1)


def hold(
    views: Sequence[View],
    known: np.ndarray,
    new: np.ndarray,
    seen: Sequence[Sequence[int]] | None = None,
) -> NewPoints:
    """``verify`` of new points [M, 3]; ``seen``: the originals of each view, all when left out."""
    seen = [range(len(known))] * len(views) if seen is None else seen
    starts = np.cumsum([0, *map(len, seen)]).tolist()
    visibility = Visibility(
        np.asarray(known, np.float64),
        np.array([row for each in seen for row in each], np.int64),
        dict(enumerate(starts)),
        {k: len(each) for k, each in enumerate(seen)},
    )
    images = [_image(k, view) for k, view in enumerate(views)]
    return verify(views, images, visibility, numbered(new))


def numbered(xyz: np.ndarray) -> NewPoints:
    """Points whose colours say which they are."""
    number = np.arange(len(xyz))
    rgb = np.stack([number % 256, number // 256, 0 * number], axis=1).astype(np.uint8)
    return NewPoints(np.asarray(xyz, np.float32), rgb, source=np.full(len(xyz), 4, np.uint8))


def numbers(points: NewPoints) -> np.ndarray:
    """Which of the points that were given are left, [K]."""
    return np.asarray(points.rgb[:, 0].astype(int) + 256 * points.rgb[:, 1].astype(int))


def _image(number: int, view: View) -> Image:
    K, pose = view.K, view.cam_from_world
    lens = Intrinsics(1, "PINHOLE", view.width, view.height, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    return Image(view.name, number, lens, quat_from_rotation(pose[:3, :3]), pose[:3, 3])
