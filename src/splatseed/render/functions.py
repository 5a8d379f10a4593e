"""The CPU stages as PyTorch functions, one camera at a time.

``Project``, ``Harmonics`` and ``Blend`` are separate so that the 2D means between the first and the
last are an ordinary tensor: densification strategies watch its gradient. Tensors are float32 on the
CPU; NumPy views of them go to the kernels without a copy.
"""

# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatseed.render import blending, harmonics as sh, projection
from splatseed.render.binning import TILE, TileLists, depth_order, list_tiles

__all__ = ["Blend", "Harmonics", "Lens", "Project"]

FARTHEST = np.log(np.float32(255.0))


class Lens(NamedTuple):
    """What of a camera is not differentiated."""

    K: np.ndarray
    """float32 [3, 3]."""
    width: int
    height: int
    near: float
    far: float
    eps2d: float
    radius_clip: float
    antialiased: bool


def _array(tensor: Tensor) -> np.ndarray:
    return np.asarray(tensor.detach().contiguous().numpy())


class Project(torch.autograd.Function):
    """3D Gaussians to one camera's image plane.

    Inputs: means [N, 3], quats [N, 4], scales [N, 3], opacities [N], viewmat [4, 4], lens.
    Outputs: radii [N, 2], means2d [N, 2], depths [N], conics [N, 3], compensations [N].

    Opacities only bound the radii; they get no gradient here, as in gsplat.
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        viewmat: Tensor,
        lens: Lens,
    ) -> tuple[Tensor, ...]:
        """Run the kernel and keep what backward needs."""
        arrays = [_array(t) for t in (means, quats, scales, opacities, viewmat)]
        n = len(means)
        radii, out = (
            np.empty((n, 2), np.int32),
            [np.zeros(shape, np.float32) for shape in ((n, 2), (n,), (n, 3), (n,))],
        )
        projection.project(*arrays, *lens, radii, *out)  # type: ignore[call-arg]  # star arguments
        ctx.save_for_backward(means, quats, scales, viewmat)
        ctx.lens, ctx.radii = lens, radii
        results = [torch.from_numpy(each) for each in (radii, *out)]
        ctx.mark_non_differentiable(results[0])
        return tuple(results)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        """Gradients of the inputs."""
        means, quats, scales, viewmat = (_array(t) for t in ctx.saved_tensors)
        lens: Lens = ctx.lens
        results = [np.zeros(each.shape, np.float32) for each in (means, quats, scales)]
        by_view = np.zeros((projection.CHUNKS, 4, 4))
        projection.project_vjp(  # type: ignore[call-arg]  # star arguments
            means, quats, scales, viewmat, lens.K, lens.width, lens.height, lens.eps2d, ctx.radii,
            *(_array(g) for g in gradients[1:]), *results, by_view,
        )  # fmt: skip
        d_view = torch.from_numpy(by_view.sum(axis=0).astype(np.float32))
        return (*(torch.from_numpy(r) for r in results), None, d_view, None)


class Harmonics(torch.autograd.Function):
    """Directions [N, 3], coefficients [N, K, 3], visible [N], degree to colours [N, 3]."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, directions: Tensor, coefficients: Tensor, visible: Tensor, degree: int
    ) -> Tensor:
        """Run the kernel and keep what backward needs."""
        colors = np.empty((len(directions), 3), np.float32)
        sh.harmonics(
            _array(directions), _array(coefficients), _array(visible), (degree + 1) ** 2, colors
        )
        ctx.save_for_backward(directions, coefficients, visible)
        ctx.degree = degree
        return torch.from_numpy(colors)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_colors: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        """Gradients of the inputs."""
        directions, coefficients, visible = (_array(t) for t in ctx.saved_tensors)
        results = [np.zeros(each.shape, np.float32) for each in (directions, coefficients)]
        terms = (ctx.degree + 1) ** 2
        sh.harmonics_vjp(directions, coefficients, visible, terms, _array(d_colors), *results)
        return (*(torch.from_numpy(r) for r in results), None, None)


class _Prepared(NamedTuple):
    """A view sorted and listed: what forward and backward share."""

    order: np.ndarray
    lists: TileLists
    width: int
    height: int

    @property
    def columns(self) -> int:
        return -(-self.width // TILE)

    @property
    def rows(self) -> int:
        return -(-self.height // TILE)


class Blend(torch.autograd.Function):
    """Projected Gaussians to an image.

    Inputs: means2d [G, 2], conics [G, 3], colours [G, D], opacities [G], background [D] or None,
    depths [G], radii [G, 2], width, height, on_absgrad. Outputs: image [H, W, D], alphas [H, W].

    ``on_absgrad``: None, or called by backward with the summed absolute gradients of the 2D means,
    [G, 2].
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        means2d: Tensor,
        conics: Tensor,
        colors: Tensor,
        opacities: Tensor,
        background: Tensor | None,
        depths: Tensor,
        radii: Tensor,
        width: int,
        height: int,
        on_absgrad: Callable[[Tensor], None] | None,
    ) -> tuple[Tensor, Tensor]:
        """Run the kernel and keep what backward needs."""
        prepared = _prepare(means2d, conics, colors, opacities, depths, radii, width, height)
        parts, transmittance = [], np.empty(0, np.float32)
        for first in range(0, colors.shape[1], blending.CHANNELS):
            records = _records(prepared, means2d, conics, colors, opacities, first)
            block_image, transmittance = _forward(prepared, records)
            parts.append(_to_image(prepared, block_image, blending.CHANNELS))
        image = np.concatenate(parts, axis=2)[:, :, : colors.shape[1]]
        passing = _to_image(prepared, transmittance, 1)
        if background is not None:
            image = image + passing * _array(background)
        ctx.prepared, ctx.on_absgrad, ctx.passing = prepared, on_absgrad, passing
        ctx.image = np.ascontiguousarray(image)
        ctx.save_for_backward(means2d, conics, colors, opacities, background)
        return torch.from_numpy(ctx.image), torch.from_numpy(1.0 - passing[:, :, 0])

    @staticmethod
    @once_differentiable
    def backward(  # type: ignore[override]
        ctx: Any, d_image: Tensor, d_alphas: Tensor
    ) -> tuple[Tensor | None, ...]:
        """Gradients of the inputs."""
        means2d, conics, colors, opacities, background = ctx.saved_tensors
        prepared: _Prepared = ctx.prepared
        gradient = _array(d_image)
        passing = ctx.passing
        # What lies behind the first Gaussian: all of the image; every chunk of channels takes its
        # own part, and the first the gradient of alpha too.
        d_colors = np.zeros(tuple(colors.shape), np.float32)
        geometry = np.zeros((len(prepared.order), blending.SUMS), np.float32)
        for first in range(0, colors.shape[1], blending.CHANNELS):
            channels = slice(first, first + blending.CHANNELS)
            behind = (gradient[:, :, channels] * ctx.image[:, :, channels]).sum(axis=2)
            if first == 0:
                behind = behind - _array(d_alphas) * passing[:, :, 0]
            records = _records(prepared, means2d, conics, colors, opacities, first)
            totals = _backward(prepared, records, gradient[:, :, channels], behind)
            wide = min(blending.CHANNELS, colors.shape[1] - first)
            d_colors[prepared.order, first : first + wide] = totals[:, 6 : 6 + wide]
            geometry += totals
        scattered = np.zeros((len(means2d), blending.SUMS), np.float32)
        scattered[prepared.order] = geometry
        if ctx.on_absgrad is not None:
            ctx.on_absgrad(torch.from_numpy(scattered[:, 10:12].copy()))
        d_background = None
        if background is not None and ctx.needs_input_grad[4]:
            d_background = torch.from_numpy((gradient * passing).sum(axis=(0, 1)))
        return (
            torch.from_numpy(scattered[:, 0:2].copy()),
            torch.from_numpy(scattered[:, 2:5].copy()),
            torch.from_numpy(d_colors),
            torch.from_numpy(scattered[:, 5].copy()),
            d_background,
            *(None,) * 5,
        )


def _prepare(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    depths: Tensor,
    radii: Tensor,
    width: int,
    height: int,
) -> _Prepared:
    """Sort what is visible by depth and list it by tile.

    A colour that is not finite is left out here: 0 times NaN would carry it to every pixel of a tile.
    """
    alphas = _array(opacities)
    seen = (_array(radii) > 0).all(axis=1) & (alphas >= projection.MIN_ALPHA)
    seen &= np.isfinite(_array(colors)).all(axis=1)
    order = depth_order(_array(depths), seen)
    reach = _reach(alphas[order])
    lists = list_tiles(_array(means2d)[order], _array(conics)[order], reach, width, height)
    return _Prepared(order, lists, width, height)


def _reach(opacities: np.ndarray) -> np.ndarray:
    """log(255 opacity), float32: how large sigma can be for alpha to reach 1/255.

    An opacity above 1 reaches no farther than 1 does, where the kernels' exponential ends.
    """
    return np.clip(np.log(255.0 * opacities, dtype=np.float32), 0.0, FARTHEST)


def _records(
    prepared: _Prepared,
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    first: int,
) -> np.ndarray:
    """The Gaussians in depth order as ``blending`` reads them, flat."""
    order = prepared.order
    records = np.zeros((len(order), blending.RECORD), np.float32)
    records[:, 0:2] = _array(means2d)[order]
    records[:, 2:5] = _array(conics)[order]
    records[:, 5] = _array(opacities)[order]
    records[:, 6] = -_reach(records[:, 5])
    part = _array(colors)[order, first : first + blending.CHANNELS]
    records[:, 7 : 7 + part.shape[1]] = part
    return records.reshape(-1)


def _forward(prepared: _Prepared, records: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    blocks = prepared.rows * prepared.columns * blending.BLOCKS
    image = np.empty(blocks * blending.CHANNELS * 16, np.float32)
    transmittance = np.empty(blocks * 16, np.float32)
    blending.forward(
        records, prepared.lists.tile_start, prepared.lists.listed_rank, prepared.columns,
        blending.COLUMN, blending.ROW, image, transmittance,
    )  # fmt: skip
    return image, transmittance


def _backward(
    prepared: _Prepared, records: np.ndarray, gradient: np.ndarray, behind: np.ndarray
) -> np.ndarray:
    """Gradient sums of every visible Gaussian, by depth rank, [G, 16]."""
    lists = prepared.lists
    sums = np.zeros(len(lists.listed_rank) * blending.SUMS, np.float32)
    blending.backward(
        records, lists.tile_start, lists.listed_rank, lists.listed_slot, prepared.columns,
        blending.COLUMN, blending.ROW, _to_blocks(prepared, gradient, blending.CHANNELS),
        _to_blocks(prepared, behind[:, :, None], 1), sums,
    )  # fmt: skip
    totals = np.empty((len(prepared.order), blending.SUMS), np.float32)
    blending.sum_pairs(lists.slot_start, sums, totals)
    return totals


def _to_image(prepared: _Prepared, blocks: np.ndarray, channels: int) -> np.ndarray:
    """A block image as [H, W, channels]."""
    rows, columns = prepared.rows, prepared.columns
    tiled = blocks.reshape(rows, columns, 2, 2, channels, 4, 4).transpose(0, 2, 5, 1, 3, 6, 4)
    image = tiled.reshape(rows * TILE, columns * TILE, channels)
    return image[: prepared.height, : prepared.width]


def _to_blocks(prepared: _Prepared, image: np.ndarray, channels: int) -> np.ndarray:
    """[H, W, up to ``channels``] as a flat block image, padded with 0."""
    rows, columns = prepared.rows, prepared.columns
    padded = np.zeros((rows * TILE, columns * TILE, channels), np.float32)
    padded[: prepared.height, : prepared.width, : image.shape[2]] = image
    tiled = padded.reshape(rows, 2, 4, columns, 2, 4, channels).transpose(0, 3, 1, 4, 6, 2, 5)
    return np.ascontiguousarray(tiled).reshape(-1)
