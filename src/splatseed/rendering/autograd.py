"""Wrap the kernels as PyTorch autograd functions, one camera at a time.

``Project``, ``Harmonics`` and ``Blend`` are separate so that the 2D means between the first and the
last are an ordinary tensor, whose gradient densification strategies read. Tensors are float32 on
the CPU; kernels get NumPy views of them, without a copy.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatseed.rendering._kernels import blending, blending_vjp, harmonics as sh, layout, projection
from splatseed.rendering._kernels.binning import RECORD, TILE
from splatseed.rendering.binning import TileLists, depth_order, list_tiles, row_order
from splatseed.rendering.harmonics import TABLES, TERMS

MAX_OPACITY = np.float32(1e6)
"""Larger opacities are clamped: beyond 1, an opacity only widens a Gaussian."""
ALIGNMENT = 64
"""Bytes of a cache line and of an AVX-512 register."""


class ProjectionParams(NamedTuple):
    """Constants of a projection, without gradients."""

    K: np.ndarray
    """float32 [3, 3]."""
    width: int
    height: int
    near: float
    far: float
    eps2d: float
    radius_clip: float
    antialiased: bool


def _arrays(*tensors: Tensor) -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(each.detach().contiguous().numpy()) for each in tensors)


def is_seen(radii: Tensor) -> Tensor:
    """Return which Gaussians of radii [N, 2] are not culled, bool [N]."""
    return (radii[:, 0] > 0) & (radii[:, 1] > 0)  # all() takes four times as long


class Project(torch.autograd.Function):
    """Project 3D Gaussians to a camera's image plane.

    Inputs: means [N, 3], quats [N, 4], scales [N, 3], opacities [N], viewmat [4, 4], params,
    sparse.
    Outputs: radii [N, 2], means2d [N, 2], depths [N], conics [N, 3], compensations [N].

    Opacities only bound the radii; as in gsplat, they get no gradient here. With ``sparse``, the
    gradients of means, quats and scales contain only visible Gaussians (COO).
    """

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        """Run the kernel and keep what backward needs."""
        means, quats, scales, _, viewmat, params, sparse = inputs
        n = len(means)
        radii = np.empty((n, 2), np.int32)
        out = [np.empty(shape, np.float32) for shape in ((n, 2), n, (n, 3), n)]
        projection.project(*_arrays(*inputs[:5]), *params, radii, *out)  # type: ignore[call-arg]  # star arguments
        ctx.save_for_backward(means, quats, scales, viewmat)
        ctx.params, ctx.radii, ctx.sparse = params, radii, sparse
        results = tuple(map(torch.from_numpy, (radii, *out)))
        ctx.mark_non_differentiable(results[0])  # whole numbers
        return results

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Compute the gradients of the inputs."""
        means, quats, scales, viewmat = _arrays(*ctx.saved_tensors)
        params: ProjectionParams = ctx.params
        results = [np.empty(each.shape, np.float32) for each in (means, quats, scales)]
        by_view = np.empty((projection.CHUNKS, 3, 4))
        projection.project_vjp(  # type: ignore[call-arg]  # star arguments
            means, quats, scales, viewmat, params.K, params.width, params.height, params.eps2d,
            ctx.radii, *_arrays(*gradients[1:]), *results, by_view,
        )  # fmt: skip
        d_view = torch.zeros(4, 4)  # the last row of a pose is constant
        d_view[:3] = torch.from_numpy(by_view.sum(axis=0))
        d_inputs = [torch.from_numpy(each) for each in results]
        if ctx.sparse:
            rows = is_seen(torch.from_numpy(ctx.radii)).nonzero()[:, 0]
            d_inputs = [
                torch.sparse_coo_tensor(
                    rows[None], each[rows], each.shape, is_coalesced=True, check_invariants=False
                )
                for each in d_inputs
            ]
        return *d_inputs, None, d_view, None, None


class Harmonics(torch.autograd.Function):
    """Evaluate spherical harmonics to colours [N, 3]: colour = max(0, 1/2 + sum_k y_k h_k).

    Inputs: means [N, 3], the camera's centre [3], coefficients, radii [N, 2], degree. Coefficients
    are two tensors, [N, 1, 3] and [N, K - 1, 3], or one, [N, K, 3], and None.
    """

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        """Run the kernel and keep what backward needs."""
        means, origin, base, rest, radii, degree = inputs
        colors = np.empty((len(means), 3), np.float32)
        sh.harmonics(  # type: ignore[call-arg]  # star arguments
            *_arrays(means, origin), *_coefficients(base, rest), *_arrays(radii),
            TABLES[degree], colors,
        )  # fmt: skip
        ctx.save_for_backward(*inputs[:5])
        ctx.degree, ctx.colors = degree, colors
        return torch.from_numpy(colors)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_colors: Tensor) -> tuple[Tensor | None, ...]:
        """Compute the gradients of the inputs."""
        means, origin, base, rest, radii = ctx.saved_tensors
        first, rows, skipped = _coefficients(base, rest)
        d_means, d_rows = np.empty(means.shape, np.float32), np.empty(rows.shape, np.float32)
        d_first = d_rows.reshape(first.shape) if rest is None else np.empty(first.shape, np.float32)
        sh.harmonics_vjp(  # type: ignore[call-arg]  # star arguments
            *_arrays(means, origin), rows, skipped, *_arrays(radii), TABLES[ctx.degree],
            ctx.colors, *_arrays(d_colors), d_means, d_first, d_rows,
        )  # fmt: skip
        d_base, d_rest, d_origin = torch.from_numpy(_resized(d_first, base.shape[1])), None, None
        if rest is not None:
            own = d_rows.reshape(len(rest), TERMS - 1, 3)
            d_rest = torch.from_numpy(_resized(own, rest.shape[1]))
        if ctx.needs_input_grad[1]:
            # Colours depend on mean - origin alone.
            d_origin = torch.from_numpy(-d_means.sum(axis=0, dtype=np.float64)).to(origin.dtype)
        return torch.from_numpy(d_means), d_origin, d_base, d_rest, None, None


def _coefficients(base: Tensor, rest: Tensor | None) -> tuple[np.ndarray, np.ndarray, int]:
    """Return ``base``, ``rest`` and ``skipped`` for the kernel ``harmonics``."""
    if rest is None:
        joined = _resized(_arrays(base)[0], TERMS)
        return joined, joined.reshape(-1), 3
    first, rows = _arrays(base, rest)
    return first, _resized(rows, TERMS - 1).reshape(-1), 0


def _resized(array: np.ndarray, count: int) -> np.ndarray:
    """Pad with zeros or cut to ``count`` along axis 1; copy only if that changes the array."""
    kept = array[:, :count]
    missing = count - kept.shape[1]
    return np.ascontiguousarray(np.pad(kept, ((0, 0), (0, missing), (0, 0))) if missing else kept)


class _Prepared(NamedTuple):
    """Gaussians sorted by depth and listed by tile, for forward and backward."""

    order: np.ndarray
    log_opacities: np.ndarray
    records: np.ndarray
    """Records of the first pass of channels."""
    lists: TileLists
    columns: int
    """Tiles per row."""
    rows: int

    def records_from(self, first: int, *arrays: np.ndarray) -> np.ndarray:
        """Return the records of the pass that starts with this channel."""
        if first == 0:
            return self.records
        return _gather(first, self.order, self.log_opacities, *arrays)

    def blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """Allocate a block image of a pass, and one with one number per pixel."""
        lanes = self.columns * self.rows * TILE**2
        return _aligned(lanes * blending.CHANNELS), _aligned(lanes)


class Blend(torch.autograd.Function):
    """Blend projected Gaussians into an image.

    Inputs: means2d [G, 2], conics [G, 3], colours [G, D], opacities [G], background [D] or None,
    depths [G], radii [G, 2], width, height, absgrad. Outputs: image [H, W, D], alphas [H, W].

    Backward writes the summed absolute gradients of the 2D means to ``absgrad`` [G, 2], or None.
    """

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor]:
        """Run the kernel and keep what backward needs."""
        *tensors, background, depths, radii, width, height, absgrad = inputs
        arrays = _arrays(*tensors, depths, radii)
        prepared, channels = _prepare(width, height, *arrays), arrays[2].shape[1]
        behind = np.zeros(channels, np.float32) if background is None else _arrays(background)[0]
        image = np.empty((height, width, channels), np.float32)
        transmittance = np.empty((height, width), np.float32)
        # Kept for backward, which visits only the blocks that forward blended.
        hits = np.empty(len(prepared.lists.listed_rank), np.uint8)
        for first in range(0, channels, blending.CHANNELS):
            blocks = prepared.blocks()
            blending.forward(
                prepared.records_from(first, *arrays[:3]), prepared.lists.tile_start,
                prepared.lists.listed_rank, row_order(prepared.rows), blending.COLUMN, blending.ROW,
                channels - first >= blending.CHANNELS, *blocks, hits,
            )  # fmt: skip
            layout.from_blocks(*blocks, prepared.columns, behind, first, image, transmittance)
        ctx.prepared, ctx.absgrad, ctx.hits = prepared, absgrad, hits
        ctx.transmittance, ctx.image = transmittance, image
        ctx.save_for_backward(*tensors, background)
        return torch.from_numpy(image), torch.from_numpy(1.0 - transmittance)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Compute the gradients of the inputs."""
        *tensors, background = ctx.saved_tensors
        means2d, conics, colors, opacities = _arrays(*tensors)
        gradient, alphas = _arrays(*upstream)
        prepared: _Prepared = ctx.prepared
        lists, transmittance = prepared.lists, ctx.transmittance
        absolute = ctx.absgrad is not None
        shapes = [each.shape for each in (means2d, conics, opacities, colors)]
        shapes.append(means2d.shape if absolute else (0, 2))
        results = [np.zeros(shape, np.float32) for shape in shapes]
        for first in range(0, colors.shape[1], blending.CHANNELS):
            blocks = prepared.blocks()
            layout.to_blocks(
                gradient, ctx.image, alphas, transmittance, prepared.columns, first, *blocks
            )
            sums = _aligned(int(lists.span_start[-1]) * blending_vjp.SUMS, zero=True)
            blending_vjp.backward(
                prepared.records_from(first, means2d, conics, colors), lists.tile_start,
                lists.listed_rank, lists.listed_span, ctx.hits, row_order(prepared.rows),
                blending.COLUMN, blending.ROW, colors.shape[1] - first >= blending.CHANNELS,
                *blocks, absolute, sums,
            )  # fmt: skip
            totals = np.empty((len(prepared.order), blending_vjp.SUMS), np.float32)
            blending_vjp.sum_spans(lists.span_start, sums, totals)
            layout.scatter(prepared.order, totals, first, conics, opacities, *results)
        d_means2d, d_conics, d_opacities, d_colors, d_absolute = map(torch.from_numpy, results)
        if absolute:
            ctx.absgrad.copy_(d_absolute)
        d_background = None
        if background is not None and ctx.needs_input_grad[4]:
            # image = colour + T background
            d_background = torch.from_numpy((gradient * transmittance[:, :, None]).sum(axis=(0, 1)))
        return d_means2d, d_conics, d_colors, d_opacities, d_background, *(None,) * 5


def _prepare(width: int, height: int, *arrays: np.ndarray) -> _Prepared:
    """Sort visible Gaussians by depth and list them by tile; arrays are inputs of ``Blend``."""
    means2d, conics, colors, opacities, depths, radii = arrays
    visible = np.empty(len(opacities), np.bool_)
    layout.find_visible(radii, opacities, colors, projection.MIN_ALPHA, visible)
    order = depth_order(depths, visible)
    # Records hold log opacities: alpha = exp(log opacity - sigma) takes no product.
    log_opacities = np.log(np.minimum(opacities.take(order), MAX_OPACITY), dtype=np.float32)
    records = _gather(0, order, log_opacities, means2d, conics, colors)
    lists = list_tiles(records, width, height)
    return _Prepared(order, log_opacities, records, lists, -(-width // TILE), -(-height // TILE))


def _gather(
    first: int, order: np.ndarray, log_opacities: np.ndarray, *arrays: np.ndarray
) -> np.ndarray:
    """Return the flat records of Gaussians in depth order, from this channel on."""
    means2d, conics, colors = arrays
    records = _aligned(len(order) * RECORD)
    layout.gather(order, means2d, conics, log_opacities, colors, first, records)
    return records


def _aligned(size: int, *, zero: bool = False) -> np.ndarray:
    """Allocate a float32 array aligned to the size of a vector register."""
    array = (np.zeros if zero else np.empty)(size + ALIGNMENT // 4, np.float32)
    first = -(array.ctypes.data // 4) % (ALIGNMENT // 4)
    return array[first : first + size]
