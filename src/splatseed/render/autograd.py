"""The CPU stages as PyTorch autograd functions, one camera at a time.

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

from splatseed.render import blending, blending_vjp, harmonics as sh, layout, projection
from splatseed.render.binning import RECORD, TILE, TileLists, depth_order, list_tiles, row_order

GREATEST = np.float32(1e6)
"""Opacities above this are clamped: beyond 1 they only make a Gaussian wider."""
ALIGNMENT = 64
"""Bytes of a cache line and of an AVX-512 register."""


class Lens(NamedTuple):
    """The constants of a projection: no gradient flows to them."""

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

    Inputs: means [N, 3], quats [N, 4], scales [N, 3], opacities [N], viewmat [4, 4], lens, sparse.
    Outputs: radii [N, 2], means2d [N, 2], depths [N], conics [N, 3], compensations [N].

    Opacities only bound the radii; they get no gradient here, as in gsplat. With ``sparse`` the
    gradients of means, quats and scales list only the Gaussians that this camera sees.
    """

    @staticmethod
    def forward(  # type: ignore[override]  # PyTorch's own takes anything
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        viewmat: Tensor,
        lens: Lens,
        sparse: bool,
    ) -> tuple[Tensor, ...]:
        """Run the kernel and keep what backward needs."""
        arrays = [_array(t) for t in (means, quats, scales, opacities, viewmat)]
        n = len(means)
        radii, out = (
            np.empty((n, 2), np.int32),
            [np.empty(shape, np.float32) for shape in ((n, 2), (n,), (n, 3), (n,))],
        )
        projection.project(*arrays, *lens, radii, *out)  # type: ignore[call-arg]  # star arguments
        ctx.save_for_backward(means, quats, scales, viewmat)
        ctx.lens, ctx.radii, ctx.sparse = lens, radii, sparse
        results = [torch.from_numpy(each) for each in (radii, *out)]
        # Radii are whole numbers.
        ctx.mark_non_differentiable(results[0])
        return tuple(results)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]  # PyTorch's own takes anything
        """Gradients of the inputs."""
        means, quats, scales, viewmat = (_array(t) for t in ctx.saved_tensors)
        lens: Lens = ctx.lens
        results = [np.empty(each.shape, np.float32) for each in (means, quats, scales)]
        by_view = np.empty((projection.CHUNKS, 3, 4))
        projection.project_vjp(  # type: ignore[call-arg]  # star arguments
            means, quats, scales, viewmat, lens.K, lens.width, lens.height, lens.eps2d, ctx.radii,
            *(_array(g) for g in gradients[1:]), *results, by_view,
        )  # fmt: skip
        d_view = torch.zeros(4, 4)
        # The last row of a pose is constant.
        d_view[:3] = torch.from_numpy(by_view.sum(axis=0))
        d_inputs = [torch.from_numpy(each) for each in results]
        if ctx.sparse:
            rows = is_seen(torch.from_numpy(ctx.radii)).nonzero()[:, 0]
            d_inputs = [_sparse(each, rows) for each in d_inputs]
        return *d_inputs, None, d_view, None, None


def is_seen(radii: Tensor) -> Tensor:
    """Which Gaussians of radii [N, 2] are not culled, bool [N]."""
    return (radii[:, 0] > 0) & (radii[:, 1] > 0)  # all() takes four times as long


def _sparse(dense: Tensor, rows: Tensor) -> Tensor:
    """A COO tensor of the given rows, in ascending order; all others are 0."""
    return torch.sparse_coo_tensor(
        rows[None], dense[rows], dense.shape, is_coalesced=True, check_invariants=False
    )


class Harmonics(torch.autograd.Function):
    """Spherical harmonics to colours [N, 3]: colour = max(0, 1/2 + sum_k y_k h_k).

    Inputs: means [N, 3], the camera's centre [3], coefficients, radii [N, 2], degree. Coefficients
    come in one tensor [N, K, 3] and None, or in two, [N, 1, 3] and [N, K - 1, 3].
    """

    @staticmethod
    def forward(  # type: ignore[override]  # PyTorch's own takes anything
        ctx: Any,
        means: Tensor,
        origin: Tensor,
        base: Tensor,
        rest: Tensor | None,
        radii: Tensor,
        degree: int,
    ) -> Tensor:
        """Run the kernel and keep what backward needs."""
        colors = np.empty((len(means), 3), np.float32)
        sh.harmonics(  # type: ignore[call-arg]  # star arguments
            _array(means), _array(origin), *_coefficients(base, rest), _array(radii),
            sh.TABLES[degree], colors,
        )  # fmt: skip
        ctx.save_for_backward(means, origin, base, rest, radii)
        ctx.degree, ctx.colors = degree, colors
        return torch.from_numpy(colors)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_colors: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]  # PyTorch's own takes anything
        """Gradients of the inputs."""
        means, origin, base, rest, radii = ctx.saved_tensors
        first, rows, skipped = _coefficients(base, rest)
        d_means, d_rows = np.empty(means.shape, np.float32), np.empty(rows.shape, np.float32)
        d_first = d_rows.reshape(first.shape) if rest is None else np.empty(first.shape, np.float32)
        sh.harmonics_vjp(  # type: ignore[call-arg]  # star arguments
            _array(means), _array(origin), rows, skipped, _array(radii), sh.TABLES[ctx.degree],
            ctx.colors, _array(d_colors), d_means, d_first, d_rows,
        )  # fmt: skip
        d_base, d_rest = torch.from_numpy(_resized(d_first, base.shape[1])), None
        if rest is not None:
            d_rest = torch.from_numpy(
                _resized(d_rows.reshape(len(rest), sh.TERMS - 1, 3), rest.shape[1])
            )
        d_origin = None
        if ctx.needs_input_grad[1]:
            # Colours depend on mean - origin alone.
            d_origin = torch.from_numpy(-d_means.sum(axis=0, dtype=np.float64)).to(origin.dtype)
        return torch.from_numpy(d_means), d_origin, d_base, d_rest, None, None


def _coefficients(base: Tensor, rest: Tensor | None) -> tuple[np.ndarray, np.ndarray, int]:
    """``base``, ``rest`` and ``skipped`` as ``harmonics`` has them."""
    if rest is None:
        joined = _resized(_array(base), sh.TERMS)
        return joined, joined.reshape(-1), 3
    return _array(base), _resized(_array(rest), sh.TERMS - 1).reshape(-1), 0


def _resized(array: np.ndarray, count: int) -> np.ndarray:
    """Padded with zeros or cut to ``count`` along axis 1; not copied if that changes nothing."""
    kept = array[:, :count]
    missing = count - kept.shape[1]
    return np.ascontiguousarray(np.pad(kept, ((0, 0), (0, missing), (0, 0))) if missing else kept)


class _Prepared(NamedTuple):
    """Gaussians sorted by depth and listed by tile, which forward and backward share."""

    order: np.ndarray
    log_opacities: np.ndarray
    records: np.ndarray
    """Records of the first pass of channels."""
    lists: TileLists
    columns: int
    """Tiles per row."""
    rows: int

    @property
    def lanes(self) -> int:
        """Pixels of all tiles."""
        return self.columns * self.rows * TILE**2


class Blend(torch.autograd.Function):
    """Projected Gaussians to an image.

    Inputs: means2d [G, 2], conics [G, 3], colours [G, D], opacities [G], background [D] or None,
    depths [G], radii [G, 2], width, height, on_absgrad. Outputs: image [H, W, D], alphas [H, W].

    ``on_absgrad``: None, or called by backward with the summed absolute gradients of the 2D means,
    [G, 2].
    """

    @staticmethod
    def forward(  # type: ignore[override]  # PyTorch's own takes anything
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
        channels = colors.shape[1]
        behind = np.zeros(channels, np.float32) if background is None else _array(background)
        image = np.empty((height, width, channels), np.float32)
        transmittance = np.empty((height, width), np.float32)
        # Kept for backward, which then visits only blocks that forward blended.
        hits = np.empty(len(prepared.lists.listed_rank), np.uint8)
        for first in range(0, channels, blending.CHANNELS):
            records = _records(prepared, means2d, conics, colors, first)
            blocks = _aligned(prepared.lanes * blending.CHANNELS), _aligned(prepared.lanes)
            blending.forward(  # type: ignore[call-arg]  # star arguments
                records, prepared.lists.tile_start, prepared.lists.listed_rank,
                row_order(prepared.rows), blending.COLUMN, blending.ROW,
                channels - first >= blending.CHANNELS, *blocks, hits,
            )  # fmt: skip
            layout.from_blocks(*blocks, prepared.columns, behind, first, image, transmittance)  # type: ignore[call-arg]  # star arguments
        ctx.prepared, ctx.on_absgrad, ctx.hits = prepared, on_absgrad, hits
        ctx.transmittance, ctx.image = transmittance, image
        ctx.save_for_backward(means2d, conics, colors, opacities, background)
        return torch.from_numpy(image), torch.from_numpy(1.0 - transmittance)

    @staticmethod
    @once_differentiable
    def backward(  # type: ignore[override]  # PyTorch's own takes anything
        ctx: Any, d_image: Tensor, d_alphas: Tensor
    ) -> tuple[Tensor | None, ...]:
        """Gradients of the inputs."""
        means2d, conics, colors, opacities, background = ctx.saved_tensors
        prepared: _Prepared = ctx.prepared
        lists, transmittance = prepared.lists, ctx.transmittance
        gradient, alphas = _array(d_image), _array(d_alphas)
        absolute = ctx.on_absgrad is not None
        shapes = [tuple(each.shape) for each in (means2d, conics, opacities, colors)]
        shapes.append(shapes[0] if absolute else (0, 2))
        results = [np.zeros(shape, np.float32) for shape in shapes]
        for first in range(0, colors.shape[1], blending.CHANNELS):
            records = _records(prepared, means2d, conics, colors, first)
            blocks = _aligned(prepared.lanes * blending.CHANNELS), _aligned(prepared.lanes)
            layout.to_blocks(  # type: ignore[call-arg]  # star arguments
                gradient, ctx.image, alphas, transmittance, prepared.columns, first, *blocks
            )
            sums = _aligned(int(lists.span_start[-1]) * blending_vjp.SUMS, zero=True)
            blending_vjp.backward(  # type: ignore[call-arg]  # star arguments
                records, lists.tile_start, lists.listed_rank, lists.listed_span, ctx.hits,
                row_order(prepared.rows), blending.COLUMN, blending.ROW,
                colors.shape[1] - first >= blending.CHANNELS, *blocks, absolute, sums,
            )  # fmt: skip
            totals = np.empty((len(prepared.order), blending_vjp.SUMS), np.float32)
            blending_vjp.sum_spans(lists.span_start, sums, totals)
            layout.scatter(  # type: ignore[call-arg]  # star arguments
                prepared.order, totals, first, _array(conics), _array(opacities), *results
            )
        if absolute:
            ctx.on_absgrad(torch.from_numpy(results[4]))
        d_background = None
        if background is not None and ctx.needs_input_grad[4]:
            # image = colour + T background
            d_background = torch.from_numpy((gradient * transmittance[:, :, None]).sum(axis=(0, 1)))
        d_means2d, d_conics, d_opacities, d_colors = map(torch.from_numpy, results[:4])
        return d_means2d, d_conics, d_colors, d_opacities, d_background, *(None,) * 5


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
    """Sort what is visible by depth and list it by tile."""
    alphas = _array(opacities)
    seen = np.empty(len(alphas), np.bool_)
    layout.mark_visible(_array(radii), alphas, _array(colors), projection.MIN_ALPHA, seen)
    order = depth_order(_array(depths), seen)
    # Blending wants exponents: alpha = exp(log opacity - sigma) takes one exp, not a product.
    log_opacities = np.log(np.minimum(alphas.take(order), GREATEST), dtype=np.float32)
    records = _gathered(order, log_opacities, means2d, conics, colors, 0)
    lists = list_tiles(records, width, height)
    return _Prepared(order, log_opacities, records, lists, -(-width // TILE), -(-height // TILE))


def _records(
    prepared: _Prepared, means2d: Tensor, conics: Tensor, colors: Tensor, first: int
) -> np.ndarray:
    """The records of this pass of channels."""
    if first == 0:
        return prepared.records
    return _gathered(prepared.order, prepared.log_opacities, means2d, conics, colors, first)


def _gathered(
    order: np.ndarray,
    log_opacities: np.ndarray,
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    first: int,
) -> np.ndarray:
    """The Gaussians in depth order as ``blending`` reads them, flat."""
    records = _aligned(len(order) * RECORD)
    arrays = (_array(each) for each in (means2d, conics))
    layout.gather(order, *arrays, log_opacities, _array(colors), first, records)  # type: ignore[call-arg]  # star arguments
    return records


def _aligned(size: int, *, zero: bool = False) -> np.ndarray:
    """A float32 array aligned to the size of a vector register."""
    make = np.zeros if zero else np.empty
    array = make(size + ALIGNMENT // 4, np.float32)
    first = -(array.ctypes.data // 4) % (ALIGNMENT // 4)
    return array[first : first + size]
