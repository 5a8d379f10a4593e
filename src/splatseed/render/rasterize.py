"""``rasterization``: gsplat's signature, on the CPU.

For code written against gsplat 1.5.3: arguments, results and the ``info`` dict are gsplat's, so
that its default densification runs unchanged, and MCMC through
``splatseed.render.MCMCStrategy``. What the CPU does not support (fisheye and orthographic cameras,
distributed rendering, rolling shutter) is refused, never ignored.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from numbers import Integral
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from splatseed.errors import ParameterError
from splatseed.render.autograd import Blend, Harmonics, Lens, Project
from splatseed.render.blending import CHANNELS
from splatseed.render.harmonics import MAX_DEGREE
from splatseed.render.info import Info, Projected, make_info
from splatseed.requirements import require

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
RasterizeMode = Literal["classic", "antialiased"]
GSPLAT_TILE = 16
"""The size of the tiles that ``info`` lists, px."""
CUDA_ONLY: Mapping[str, object] = {
    "distributed": False,
    "camera_model": "pinhole",
    "segmented": False,
    "covars": None,
    "with_ut": False,
    "with_eval3d": False,
    "radial_coeffs": None,
    "tangential_coeffs": None,
    "thin_prism_coeffs": None,
    "ftheta_coeffs": None,
    "rolling_shutter": None,
    "viewmats_rs": None,
}
"""gsplat's further arguments with their defaults."""


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor | tuple[Tensor, Tensor],
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = GSPLAT_TILE,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: RasterizeMode = "classic",
    channel_chunk: int = 32,
    **unsupported: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians into C pinhole cameras; differentiable.

    "..." are batch dimensions, none or several, the same in all tensors: every batch has Gaussians
    and cameras of its own.

    Args:
        means: Centres, world, float32 [..., N, 3].
        quats: wxyz rotations of any length but 0, [..., N, 4].
        scales: Standard deviations (not their logarithms), [..., N, 3].
        opacities: 0 to 1, [..., N].
        colors: [..., N, D] or [..., C, N, D]; with ``sh_degree`` coefficients [..., N, K, 3] or
            [..., C, N, K, 3]. Beyond gsplat, the first coefficient [..., N, 1, 3] and the rest
            [..., N, K - 1, 3] may come as a pair, as trainers keep them: joining them would take a
            quarter of a training step.
        viewmats: cam_from_world, OpenCV axes, [..., C, 4, 4].
        Ks: Pinhole matrices in px, [..., C, 3, 3].
        width: Pixels.
        height: Pixels.
        near_plane: Smallest z.
        far_plane: Largest z.
        radius_clip: Gaussians no larger than this are left out, px.
        eps2d: Blur added to the 2D covariance, px^2.
        sh_degree: Degree of spherical harmonics, 0 to 3; None uses colours directly.
        packed: Whether ``info`` lists visible Gaussians only; the image is the same.
        tile_size: Side in pixels of the tiles in ``info``'s lists; rendering uses tiles of its own.
        backgrounds: Colours behind everything, [..., C, D].
        render_mode: Colour, depth accumulated (D) or expected (ED), or both.
        sparse_grad: Whether the gradients of means, quats and scales through projection are sparse
            (COO) and list only the visible Gaussians; needs ``packed`` and no batch dimensions.
            Means that also get a gradient from the harmonics' directions have a dense one, as in
            gsplat.
        absgrad: Whether ``info["means2d"].absgrad`` is set by backward.
        rasterize_mode: "antialiased" compensates opacities for the blur.
        channel_chunk: Accepted for compatibility with gsplat.
        unsupported: gsplat's further arguments; only their defaults are accepted.

    Returns:
        Colours [..., C, H, W, D] (with depth as the last channel if requested), alphas
        [..., C, H, W, 1], and ``info``, gsplat's dictionary: means2d, radii, depths, conics,
        opacities ([..., C, N, ...], or for ``packed`` [G, ...] with batch_ids, camera_ids and
        gaussian_ids, otherwise None); width, height, tile_size, tile_width, tile_height (in tiles),
        n_batches (all dimensions' product), n_cameras (of a batch); and, made when first read,
        tiles_per_gauss, isect_ids, flatten_ids, isect_offsets [..., C, tile_height, tile_width].

    Raises:
        ParameterError: An argument that the CPU rasteriser does not support, or tensors that are
            not float32 or whose shapes do not go together.
        MissingDependencyError: CUDA tensors, and no gsplat.

    Example:
        >>> import torch
        >>> one = torch.ones(1, 3)
        >>> image, alpha, info = rasterization(
        ...     means=torch.tensor([[0.0, 0.0, 2.0]]), quats=torch.tensor([[1.0, 0, 0, 0]]),
        ...     scales=0.1 * one, opacities=torch.tensor([0.9]), colors=one,
        ...     viewmats=torch.eye(4)[None],
        ...     Ks=torch.tensor([[[20.0, 0, 8], [0, 20.0, 8], [0, 0, 1]]]), width=16, height=16)
        >>> image.shape, round(float(alpha.max()), 1)
        (torch.Size([1, 16, 16, 3]), 0.7)
    """
    if isinstance(means, Tensor) and means.is_cuda:
        require("gsplat")
        from gsplat import rasterization as on_cuda  # noqa: PLC0415  (needs CUDA)

        return on_cuda(  # type: ignore[no-any-return]  # gsplat is untyped
            means, quats, scales, opacities,
            torch.cat(colors, dim=-2) if isinstance(colors, tuple) else colors,
            viewmats, Ks, width, height, near_plane, far_plane, radius_clip, eps2d, sh_degree,
            packed, tile_size, backgrounds, render_mode,
            sparse_grad, absgrad, rasterize_mode, channel_chunk, **unsupported,
        )  # fmt: skip
    _check_unsupported(unsupported)
    for name, size in (("width", width), ("height", height), ("tile_size", tile_size)):
        fits = isinstance(size, Integral) and int(size) >= 1
        _require(fits, f"{name} as an int of at least 1", size)
    # Depths sort like their bits only if they are not negative.
    for name, number in (("near_plane", near_plane), ("eps2d", eps2d)):
        _require(number >= 0, f"{name} of at least 0", number)
    degrees = (None, *range(MAX_DEGREE + 1))
    _require(sh_degree in degrees, f"an sh_degree from 0 to {MAX_DEGREE} on the CPU", sh_degree)
    for mode, modes in ((render_mode, RenderMode), (rasterize_mode, RasterizeMode)):
        _require(mode in get_args(modes), f"a mode among {', '.join(get_args(modes))}", mode)
    _check_tensors(
        colors,
        {"means": means, "quats": quats, "scales": scales, "opacities": opacities,
         "viewmats": viewmats, "Ks": Ks, "backgrounds": backgrounds},
        sh_degree,
    )  # fmt: skip
    batch = tuple(means.shape[:-2])
    fits = not sparse_grad or (packed and not batch)
    _require(fits, "packed=True and no batch dimensions with sparse_grad=True", batch or packed)
    parts = colors if isinstance(colors, tuple) else (colors,)
    views: list[Projected] = []
    shades: list[Tensor] = []
    for scene in _unbatched(batch, means, quats, scales, opacities, viewmats, Ks, *parts):
        gaussians, poses, intrinsics = scene[:4], scene[4], scene[5]
        projected = [
            _project(
                gaussians, poses[camera],
                Lens(_intrinsics(intrinsics[camera]), width, height, near_plane, far_plane, eps2d,
                     radius_clip, rasterize_mode == "antialiased"),
                sparse_grad,
            )
            for camera in range(len(poses))
        ]  # fmt: skip
        for camera, view in enumerate(projected):
            shade = _colors(scene[0], scene[6:], poses, camera, view, sh_degree)
            shades.append(_with_depth(shade, view, render_mode))
        views += projected
    # Absolute gradients of more channels than one pass takes are not additive.
    limit = f"no more than {CHANNELS} channels, depth included, with absgrad on the CPU"
    _require(not absgrad or shades[0].shape[1] <= CHANNELS, limit, shades[0].shape[1])
    info = make_info(views, batch, packed, width, height, tile_size)
    images, alphas = _blend(views, shades, info, _background(backgrounds, render_mode), absgrad)
    if render_mode in {"ED", "RGB+ED"}:
        # Accumulated depth is a sum of weights times z; divided by their sum it is the mean z.
        expected = images[..., -1:] / alphas.clamp(min=1e-10)
        images = torch.cat([images[..., :-1], expected], dim=-1)
    return images, alphas, info


def _unbatched(batch: tuple[int, ...], *tensors: Tensor) -> Iterable[tuple[Tensor, ...]]:
    """One scene after the other: all tensors without their batch dimensions."""
    if not batch:
        return [tensors]
    return zip(*(each.flatten(0, len(batch) - 1).unbind() for each in tensors), strict=True)


def _intrinsics(K: Tensor) -> np.ndarray:
    return np.asarray(K.detach().to(torch.float32).contiguous().numpy())


def _project(gaussians: Sequence[Tensor], viewmat: Tensor, lens: Lens, sparse: bool) -> Projected:
    """Means, quats, scales and opacities in one camera."""
    opacities = gaussians[3]
    radii, means2d, depths, conics, compensations = Project.apply(  # type: ignore[no-untyped-call]  # PyTorch's apply is untyped
        *gaussians, viewmat, lens, sparse
    )
    if lens.antialiased:
        opacities = opacities * compensations
    return Projected(radii, means2d, depths, conics, opacities)


def _colors(
    means: Tensor,
    colors: Sequence[Tensor],
    viewmats: Tensor,
    camera: int,
    view: Projected,
    sh_degree: int | None,
) -> Tensor:
    """Colours of N Gaussians in one camera, [N, D]; ``colors`` is one tensor or a pair."""
    base, rest = colors if len(colors) == 2 else (colors[0], None)
    if base.dim() == (3 if sh_degree is None else 4):
        base = base[camera]
    if sh_degree is None:
        return base
    # The general inverse, as in gsplat: the rigid one has another gradient off the rotations.
    origin = torch.linalg.inv_ex(viewmats[camera]).inverse[:3, 3]
    shades: Tensor = Harmonics.apply(means, origin, base, rest, view.radii, sh_degree)  # type: ignore[no-untyped-call]  # PyTorch's apply is untyped
    return shades


def _with_depth(colors: Tensor, view: Projected, render_mode: RenderMode) -> Tensor:
    """The channels of a render mode, depth last."""
    if render_mode == "RGB":
        return colors
    depth = view.depths[:, None]
    return depth if render_mode in {"D", "ED"} else torch.cat([colors, depth], dim=-1)


def _background(backgrounds: Tensor | None, render_mode: RenderMode) -> Tensor | None:
    """Backgrounds, with depth 0 if there is a depth channel."""
    if backgrounds is None or render_mode == "RGB":
        return backgrounds
    depth = torch.zeros_like(backgrounds[..., :1])
    return depth if render_mode in {"D", "ED"} else torch.cat([backgrounds, depth], dim=-1)


def _blend(
    views: Sequence[Projected],
    shades: Sequence[Tensor],
    info: Info,
    backgrounds: Tensor | None,
    absgrad: bool,
) -> tuple[Tensor, Tensor]:
    """Images [..., C, H, W, D] and alphas [..., C, H, W, 1], by way of ``info["means2d"]``."""
    means2d, ids, batch = info["means2d"], info["gaussian_ids"], info.batch
    owners = None if ids is None else info.image_ids()
    if absgrad:
        means2d.absgrad = torch.zeros_like(means2d)
    images, alphas = [], []
    places = np.ndindex(*batch, info["n_cameras"])
    if backgrounds is not None:
        backgrounds = backgrounds.reshape(len(views), -1)
    for image, (place, view, colors) in enumerate(zip(places, views, shades, strict=True)):
        rows: Any = place if owners is None else owners == image
        shapes: tuple[Tensor, ...] = (view.conics, colors, view.opacities)
        depths, radii = view.depths, view.radii
        if ids is not None:  # a full slice would be copied by backward
            each = ids[rows]
            shapes, depths, radii = tuple(t[each] for t in shapes), depths[each], radii[each]
        pixels, alpha = Blend.apply(  # type: ignore[no-untyped-call]  # PyTorch's apply is untyped
            means2d[rows], *shapes,
            None if backgrounds is None else backgrounds[image],
            depths, radii, info["width"], info["height"],
            partial(_keep_absgrad, means2d, rows) if absgrad else None,
        )  # fmt: skip
        images.append(pixels)
        alphas.append(alpha[..., None])
    # Copied even for one camera: backward reads the image, so in-place changes by the caller must
    # not reach it.
    size = (*batch, info["n_cameras"], info["height"], info["width"], -1)
    return torch.stack(images).view(size), torch.stack(alphas).view(size)


def _keep_absgrad(means2d: Any, rows: Any, gradient: Tensor) -> None:
    means2d.absgrad[rows] = gradient


def _check_unsupported(arguments: Mapping[str, object]) -> None:
    """Refuse arguments that only gsplat's CUDA code supports, and unknown ones."""
    for name, value in arguments.items():
        _require(name in CUDA_ONLY, "arguments of gsplat's rasterization", name)
        default = CUDA_ONLY[name]
        # gsplat's default for the shutter is an enumeration member, recognised by its name.
        fits = value is default or getattr(value, "name", None) == "GLOBAL"
        fits = fits or (isinstance(value, str) and value == default)
        _require(fits, f"{name} to be left at its default on the CPU", value)


def _check_tensors(
    colors: Tensor | tuple[Tensor, Tensor],
    tensors: Mapping[str, Tensor | None],
    sh_degree: int | None,
) -> None:
    """Refuse whatever the kernels, which do not check bounds, could not read."""
    parts = colors if isinstance(colors, tuple) else (colors,)
    for name, each in (*tensors.items(), *(("colors", part) for part in parts)):
        fits = isinstance(each, Tensor) and each.dtype == torch.float32
        fits = fits and each.device.type == "cpu"  # type: ignore[union-attr]  # a tensor
        optional = each is None and name == "backgrounds"
        _require(fits or optional, f"{name} as a float32 tensor on the CPU, like means", each)
    found = {name: tuple(each.shape) for name, each in tensors.items() if each is not None}
    *batch, n, _ = found["means"] if len(found["means"]) > 1 else (0, 0, 0)
    _require(0 not in batch, "means of shape [..., N, 3], no batch dimension 0", found["means"])
    cameras = found["viewmats"][-3] if len(found["viewmats"]) == len(batch) + 3 else 0
    like = f"viewmats of shape {[*batch, 'C', 4, 4]}, of at least one camera"
    _require(cameras, like, found["viewmats"])
    shared, own = (*batch, n), (*batch, cameras, n)
    expected = {
        "means": (*shared, 3), "quats": (*shared, 4), "scales": (*shared, 3), "opacities": shared,
        "viewmats": (*own[:-1], 4, 4), "Ks": (*own[:-1], 3, 3),
        "backgrounds": (*own[:-1], *parts[0].shape[-1:]),
    }  # fmt: skip
    for name, shape in found.items():
        _require(shape == expected[name], f"{name} of shape {list(expected[name])}", shape)
    _check_colors([tuple(part.shape) for part in parts], shared, own, sh_degree)


def _check_colors(
    shapes: Sequence[tuple[int, ...]],
    shared: tuple[int, ...],
    own: tuple[int, ...],
    sh_degree: int | None,
) -> None:
    """Shared by the cameras or one set per camera: the number of axes decides."""
    first, last = shapes[0], shapes[-1]
    if sh_degree is None:
        fits = len(shapes) == 1 and first[:-1] in (shared, own) and first[-1] >= 1
        expected = f"colors of shape {[*shared, 'D']} or {[*own, 'D']}"
    else:
        terms = (sh_degree + 1) ** 2
        if len(shapes) == 1:
            fits, rest = first[:-2] in (shared, own), terms
        else:
            fits, rest = len(shapes) == 2 and first == (*shared, 1, 3), terms - 1
            fits = fits and last[:-2] == shared
        fits = fits and last[-2] >= rest and last[-1] == 3
        ends = [f"K >= {terms}", 3]
        expected = f"colors of shape {[*shared, *ends]} or {[*own, *ends]}, or the former in two"
    _require(fits, expected, list(shapes))


def _require(fits: object, expected: str, found: object) -> None:
    if not fits:
        if hasattr(found, "dtype"):
            found = f"{type(found).__name__} of {found.dtype}"
        fix = "Correct the arguments of rasterization, or render on CUDA."
        raise ParameterError(expected, found=str(found), fix=fix)
