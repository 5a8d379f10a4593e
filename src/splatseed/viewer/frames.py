"""Frames of a flight: renders as pictures, split down the middle, depth as colours."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.preview.page import font
from splatseed.progress import Progress, silent
from splatseed.viewer.renderer import ModelRenderer
from splatseed.views.view import View

LINE = 2
WHITE = 255
SAMPLES = 7
"""How many frames of a path are rendered to find its depth range."""


def flight_frames(
    renderers: Sequence[ModelRenderer],
    names: Sequence[str],
    path: Sequence[View],
    *,
    depth: bool = False,
    progress: Progress = silent,
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """The frames of a path: of one model, or of two side by side.

    Args:
        renderers: One model, or two.
        names: The models' names, shown when there are two.
        path: The cameras.
        depth: Show depth, not colour.
        progress: Called with the stage and the fraction done.
    """
    limits = depth_range(renderers[0], path) if depth else (0.0, 1.0)
    for i, view in enumerate(path):
        pictures = [
            depth_colors(each.depth(view), limits) if depth else as_bytes(each.color(view))
            for each in renderers
        ]
        yield pictures[0] if len(pictures) == 1 else split_picture(pictures[0], pictures[1], *names)
        progress("render", (i + 1) / len(path))


def as_bytes(image: Float32[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Colours in [0, 1] as 8-bit integers."""
    return np.asarray(np.rint(np.clip(image, 0, 1) * 255), np.uint8)


def depth_range(renderer: ModelRenderer, path: Sequence[View]) -> tuple[float, float]:
    """Near and far along a path: the 2nd and 98th percentiles of depth, in world units."""
    every = max(1, len(path) // SAMPLES)
    depths = np.concatenate([renderer.depth(view).reshape(-1) for view in path[::every]])
    seen = depths[depths > 0]
    if not seen.size:
        return 0.0, 1.0
    near, far = (float(value) for value in np.percentile(seen, [2, 98]))
    return near, max(far, near * 1.001)


def depth_colors(
    depth: Float32[np.ndarray, "H W"], limits: tuple[float, float]
) -> UInt8[np.ndarray, "H W 3"]:
    """Depth as colours, spaced evenly in 1 / depth; near is bright, and black means no depth."""
    from matplotlib import colormaps  # noqa: PLC0415  (slow to import)

    near, far = (1 / max(limit, 1e-12) for limit in limits)
    with np.errstate(divide="ignore"):
        part = (1 / depth - far) / (near - far)
    colors = colormaps["turbo"](np.clip(part, 0, 1), bytes=True)[..., :3]
    return np.where(depth[..., None] > 0, colors, 0).astype(np.uint8)


def split_picture(
    left: UInt8[np.ndarray, "H W 3"],
    right: UInt8[np.ndarray, "H W 3"],
    left_name: str = "",
    right_name: str = "",
    *,
    at: float = 0.5,
) -> UInt8[np.ndarray, "H W 3"]:
    """The left of one picture and the right of another, labelled, with a white line between."""
    column = round(at * left.shape[1])
    named = (
        labelled(left, left_name, 0)[:, :column],
        labelled(right, right_name, column)[:, column:],
    )
    picture = np.concatenate(named, axis=1)
    picture[:, max(column - LINE // 2, 0) : column + LINE // 2] = WHITE
    return picture


def labelled(
    picture: UInt8[np.ndarray, "H W 3"], name: str, column: int
) -> UInt8[np.ndarray, "H W 3"]:
    """A picture with a name at its lower edge, starting at a given column."""
    from PIL import Image, ImageDraw  # noqa: PLC0415  (slow to import)

    if not name:
        return picture
    size = max(10, min(picture.shape[0] // 28, 28))
    image = Image.fromarray(picture)
    place = (column + size // 2, picture.shape[0] - size // 2)
    ImageDraw.Draw(image).text(
        place, name, fill="white", font=font(size), anchor="ld", stroke_width=2, stroke_fill="black"
    )
    return np.array(image)
