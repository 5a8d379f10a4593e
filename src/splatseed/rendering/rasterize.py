"""Rasterise on the CPU with gsplat's signature and its ``info`` dictionary.

For code written against gsplat 1.5.3: arguments, results and the keys, shapes, types and numbers of
``info`` are gsplat's, so that its default densification runs unchanged, and MCMC through
``splatseed.rendering.MCMCStrategy``. What the CPU cannot do (fisheye, orthographic cameras,
distributed rendering, rolling shutter) raises an error.

Notation: N Gaussians, C cameras, B batches, I = B C images, batch by batch; G = I N, or if packed
the number of visible Gaussians, image by image; P pairs of a Gaussian and a tile. ``info`` computes
lists of pairs when first read: a training step does not need them, as the rasteriser has its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral
from typing import Any, Literal, NamedTuple, get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseed.errors import ParameterError
from splatseed.rendering._kernels.blending import CHANNELS
from splatseed.rendering.autograd import Blend, Harmonics, Project, ProjectionParams, is_seen
from splatseed.rendering.harmonics import MAX_DEGREE
from splatseed.requirements import require

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
RasterizeMode = Literal["classic", "antialiased"]
GSPLAT_TILE = 16
"""Default side of the tiles in ``info``'s lists, px."""
CUDA_ONLY: Mapping[str, object] = {
    "camera_model": "pinhole",
    **dict.fromkeys(("distributed", "segmented", "with_ut", "with_eval3d"), False),
    **dict.fromkeys(("radial_coeffs", "tangential_coeffs", "thin_prism_coeffs", "ftheta_coeffs")),
    **dict.fromkeys(("covars", "rolling_shutter", "viewmats_rs")),
}
"""Arguments that only gsplat supports, with their defaults."""
LISTS = ("tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets")
"""Entries of ``info`` that are computed when first read."""


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

    "..." are any number of batch dimensions, the same in all tensors: every batch has its own
    Gaussians and cameras.

    Args:
        means: Centres, world, float32 [..., N, 3].
        quats: wxyz rotations of any length but 0, [..., N, 4].
        scales: Standard deviations (not their logarithms), [..., N, 3].
        opacities: 0 to 1, [..., N].
        colors: [..., N, D] or [..., C, N, D]; with ``sh_degree`` coefficients [..., N, K, 3] or
            [..., C, N, K, 3]. Beyond gsplat, the first coefficient [..., N, 1, 3] and the rest
            [..., N, K - 1, 3] may be a pair, as trainers store them: concatenation would take a
            quarter of a training step.
        viewmats: cam_from_world, OpenCV axes, [..., C, 4, 4].
        Ks: Pinhole matrices in px, [..., C, 3, 3].
        width: Pixels.
        height: Pixels.
        near_plane: Smallest z.
        far_plane: Largest z.
        radius_clip: Gaussians with both radii up to this are culled, px.
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
    views: list[ProjectedGaussians] = []
    shades: list[Tensor] = []
    for scene in _unbatched(batch, means, quats, scales, opacities, viewmats, Ks, *parts):
        gaussians, poses, intrinsics = scene[:4], scene[4], scene[5]
        projected = [
            _project(
                gaussians, poses[camera],
                ProjectionParams(
                    intrinsics[camera].detach().contiguous().numpy(), width, height, near_plane,
                    far_plane, eps2d, radius_clip, rasterize_mode == "antialiased",
                ),
                sparse_grad,
            )
            for camera in range(len(poses))
        ]  # fmt: skip
        for camera, view in enumerate(projected):
            shade = _colors(scene[0], scene[6:], poses, camera, view, sh_degree)
            shades.append(_channels(shade, view.depths[:, None], render_mode))
        views += projected
    # Absolute gradients of more channels than one pass takes are not additive.
    limit = f"no more than {CHANNELS} channels, depth included, with absgrad on the CPU"
    _require(not absgrad or shades[0].shape[1] <= CHANNELS, limit, shades[0].shape[1])
    info = _make_info(views, batch, packed, width, height, tile_size)
    if backgrounds is not None:
        nothing = torch.zeros_like(backgrounds[..., :1])  # depth
        backgrounds = _channels(backgrounds, nothing, render_mode).reshape(len(views), -1)
    images, alphas = _blend(views, shades, info, backgrounds, absgrad)
    if render_mode in {"ED", "RGB+ED"}:
        # Accumulated depth is a sum of weights times z; divided by their sum it is the mean z.
        expected = images[..., -1:] / alphas.clamp(min=1e-10)
        images = torch.cat([images[..., :-1], expected], dim=-1)
    return images, alphas, info


def _unbatched(batch: tuple[int, ...], *tensors: Tensor) -> Iterable[tuple[Tensor, ...]]:
    """Iterate over scenes: all tensors without their batch dimensions."""
    if not batch:
        return [tensors]
    return zip(*(each.flatten(0, len(batch) - 1).unbind() for each in tensors), strict=True)


def _project(
    gaussians: Sequence[Tensor], viewmat: Tensor, params: ProjectionParams, sparse: bool
) -> ProjectedGaussians:
    """Project means, quats, scales and opacities into one camera."""
    opacities = gaussians[3]
    radii, means2d, depths, conics, compensations = Project.apply(
        *gaussians, viewmat, params, sparse
    )
    if params.antialiased:
        opacities = opacities * compensations
    return ProjectedGaussians(radii, means2d, depths, conics, opacities)


def _colors(
    means: Tensor,
    colors: Sequence[Tensor],
    viewmats: Tensor,
    camera: int,
    view: ProjectedGaussians,
    sh_degree: int | None,
) -> Tensor:
    """Return the colours of N Gaussians in one camera, [N, D]; ``colors`` is a tensor or a pair."""
    base, rest = colors if len(colors) == 2 else (colors[0], None)
    if base.dim() == (3 if sh_degree is None else 4):
        base = base[camera]
    if sh_degree is None:
        return base
    # The general inverse, as in gsplat: the rigid one has another gradient off the rotations.
    origin = torch.linalg.inv_ex(viewmats[camera]).inverse[:3, 3]
    shades: Tensor = Harmonics.apply(means, origin, base, rest, view.radii, sh_degree)
    return shades


def _channels(colors: Tensor, depth: Tensor, render_mode: RenderMode) -> Tensor:
    if render_mode == "RGB":
        return colors
    return depth if render_mode in {"D", "ED"} else torch.cat([colors, depth], dim=-1)


def _blend(
    views: Sequence[ProjectedGaussians],
    shades: Sequence[Tensor],
    info: Info,
    backgrounds: Tensor | None,
    absgrad: bool,
) -> tuple[Tensor, Tensor]:
    """Return images [..., C, H, W, D] and alphas [..., C, H, W, 1], from ``info["means2d"]``."""
    means2d, ids = info["means2d"], info["gaussian_ids"]
    sums: Sequence[Tensor | None] = [None] * len(views)
    if absgrad:
        means2d.absgrad = torch.zeros_like(means2d)
        sums = info.by_image(means2d.absgrad)
    seen = None if ids is None else info.by_image(ids)
    behind = [None] * len(views) if backgrounds is None else backgrounds
    images, alphas = [], []
    for i, centers in enumerate(info.by_image(means2d)):
        view = views[i]
        own: tuple[Tensor, ...] = (view.conics, shades[i], view.opacities, view.depths, view.radii)
        if seen is not None:  # a full slice would be copied by backward
            own = tuple(each[seen[i]] for each in own)
        pixels, alpha = Blend.apply(
            centers, *own[:3], behind[i], *own[3:], info["width"], info["height"], sums[i]
        )
        images.append(pixels)
        alphas.append(alpha[..., None])
    # Copied even for one camera: backward reads the image, so in-place changes by the caller must
    # not reach it.
    size = (*info.batch, info["n_cameras"], info["height"], info["width"], -1)
    return torch.stack(images).view(size), torch.stack(alphas).view(size)


def _check_unsupported(arguments: Mapping[str, object]) -> None:
    """Refuse arguments that only gsplat's CUDA code supports, and unknown ones."""
    for name, value in arguments.items():
        _require(name in CUDA_ONLY, "arguments of gsplat's rasterization", name)
        # gsplat's default for the shutter is an enumeration member, recognised by its name.
        fits = value is CUDA_ONLY[name] or getattr(value, "name", None) == "GLOBAL"
        fits = fits or (isinstance(value, str) and value == CUDA_ONLY[name])
        _require(fits, f"{name} to be left at its default on the CPU", value)


def _check_tensors(
    colors: Tensor | tuple[Tensor, Tensor],
    tensors: Mapping[str, Tensor | None],
    sh_degree: int | None,
) -> None:
    """Refuse whatever the kernels, which do not check bounds, could not read."""
    parts = colors if isinstance(colors, tuple) else (colors,)
    given: dict[str, Any] = dict(tensors)
    if given["backgrounds"] is None:
        del given["backgrounds"]
    for name, each in (*given.items(), *(("colors", part) for part in parts)):
        fits = isinstance(each, Tensor) and each.dtype == torch.float32
        fits = fits and each.device.type == "cpu"
        _require(fits, f"{name} as a float32 tensor on the CPU, like means", each)
    found = {name: tuple(each.shape) for name, each in given.items()}
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
    """Check colours shared by the cameras or of one set per camera: the number of axes decides."""
    first, *others = shapes
    if sh_degree is None:
        fits = not others and first[:-1] in (shared, own) and first[-1] >= 1
        expected = f"colors of shape {[*shared, 'D']} or {[*own, 'D']}"
    else:
        terms = (sh_degree + 1) ** 2
        ends = [f"K >= {terms}", 3]
        expected = f"colors of shape {[*shared, *ends]} or {[*own, *ends]}, or the former in two"
        fits = first[:-2] in (shared, own)
        if others:
            fits = len(others) == 1 and first == (*shared, 1, 3) and others[0][:-2] == shared
        fits = fits and all(each[-1] == 3 for each in shapes)
        fits = fits and sum(each[-2] for each in shapes) >= terms
    _require(fits, expected, list(shapes))


def _require(fits: object, expected: str, found: object) -> None:
    if not fits:
        if hasattr(found, "dtype"):
            found = f"{type(found).__name__} of {found.dtype}"
        fix = "Correct the arguments of rasterization, or render on CUDA."
        raise ParameterError(expected, found=str(found), fix=fix)


class ProjectedGaussians(NamedTuple):
    """N Gaussians in one camera."""

    radii: Tensor
    """Half the sizes of their boxes, px, int32 [N, 2]; 0 where culled."""
    means2d: Tensor
    """px, [N, 2]."""
    depths: Tensor
    """z, [N]."""
    conics: Tensor
    """Inverse covariances xx, xy, yy, px^-2, [N, 3]."""
    opacities: Tensor
    """0 to 1, compensated where antialiased, [N]."""


class Info(dict[str, Any]):
    """A dictionary that computes its ``LISTS`` when ``[]`` reads one of them."""

    batch: tuple[int, ...]
    """The scenes' batch dimensions."""

    def __missing__(self, name: str) -> Any:
        if name not in LISTS:
            raise KeyError(name)
        depths, images = self["depths"], self["n_batches"] * self["n_cameras"]
        if self["camera_ids"] is None:
            owners = torch.arange(images).repeat_interleave(depths.shape[-1])
        else:
            owners = self.image_ids()
        counts, ids, rows, offsets = intersect(
            self["means2d"].reshape(-1, 2), self["radii"].reshape(-1, 2), depths.flatten(), owners,
            images, self["width"], self["height"], self["tile_size"],
        )  # fmt: skip
        offsets = offsets.view(*self.batch, self["n_cameras"], *offsets.shape[1:])
        self.update(zip(LISTS, (counts.view_as(depths), ids, rows, offsets), strict=True))
        return self[name]

    def by_image(self, each: Tensor) -> Sequence[Tensor]:
        """Split an entry by image."""
        if self["camera_ids"] is None:
            return each.flatten(0, -3).unbind()
        counts = torch.bincount(self.image_ids(), minlength=self["n_batches"] * self["n_cameras"])
        return torch.split(each, counts.tolist())

    def image_ids(self) -> Tensor:
        """Return the image index of each packed Gaussian, [G]."""
        ids: Tensor = self["batch_ids"] * self["n_cameras"] + self["camera_ids"]
        return ids


def _make_info(
    views: Sequence[ProjectedGaussians],
    batch: tuple[int, ...],
    packed: bool,
    width: int,
    height: int,
    tile_size: int,
) -> Info:
    """Make the ``info`` of I images; if packed, it lists only visible Gaussians, image by image."""
    batches = math.prod(batch)
    cameras = len(views) // batches
    info = Info(batch_ids=None, camera_ids=None, gaussian_ids=None)
    if packed:
        ids = [torch.nonzero(is_seen(view.radii))[:, 0] for view in views]
        images = torch.cat([torch.full_like(each, image) for image, each in enumerate(ids)])
        info["batch_ids"], info["camera_ids"] = images // cameras, images % cameras
        info["gaussian_ids"] = torch.cat(ids)
    for name, tensors in zip(ProjectedGaussians._fields, zip(*views, strict=True), strict=True):
        if packed:
            info[name] = torch.cat([t[each] for t, each in zip(tensors, ids, strict=True)])
        else:  # a single image's entries are not copied
            stacked = tensors[0][None] if len(tensors) == 1 else torch.stack(tensors)
            info[name] = stacked.view(*batch, cameras, *stacked.shape[1:])
    info.update(
        tile_width=-(-width // tile_size),
        tile_height=-(-height // tile_size),
        width=width,
        height=height,
        tile_size=tile_size,
        n_batches=batches,
        n_cameras=cameras,
    )
    info.batch = batch
    return info


@torch.no_grad()
def intersect(
    means2d: Float[Tensor, "G 2"],
    radii: Int[Tensor, "G 2"],
    depths: Float[Tensor, " G"],
    images: Int[Tensor, " G"],
    count: int,
    width: int,
    height: int,
    size: int,
) -> tuple[Int[Tensor, " G"], Int[Tensor, " P"], Int[Tensor, " P"], Int[Tensor, "I rows columns"]]:
    """Pair Gaussians with the tiles that their bounding boxes reach.

    Equivalent to gsplat's ``isect_tiles`` and ``isect_offset_encode``. From the highest bit down, a
    pair's id holds its image, its tile (in row-major order, in as many bits as the number of tiles
    needs) and the 32 bits of its depth, so that sorted ids are ordered by image, tile and depth.

    Args:
        means2d: Centres, px.
        radii: Half-sizes of the boxes, px; 0 where culled.
        depths: z, at least 0.
        images: The image of each Gaussian.
        count: Number of images, I.
        width: Pixels.
        height: Pixels.
        size: Side of a tile, px.

    Returns:
        The number of tiles that each Gaussian touches; the sorted ids, int64; the Gaussian of each
        pair; the first pair of each tile.
    """
    columns, rows = -(-width // size), -(-height // size)
    tiles = columns * rows
    limit, zero = torch.tensor([columns, rows], dtype=torch.float32), torch.zeros(2)
    center, reach = means2d / size, radii / size
    # First column and row of tiles of each box, and the number of both; 0 if culled.
    first = torch.floor(center - reach).clamp(zero, limit)
    sizes = torch.ceil(center + reach).clamp(zero, limit) - first
    first, sizes = first.long(), sizes.long() * is_seen(radii)[:, None]
    counts = sizes.prod(dim=1)
    owner = torch.repeat_interleave(counts)
    # Each pair's number within its Gaussian's box of tiles, row by row.
    place = torch.arange(len(owner)) - (counts.cumsum(0) - counts)[owner]
    across = sizes[owner, 0]
    tile = (first[owner, 1] + place // across) * columns + first[owner, 0] + place % across
    # Bits of a positive float sort like the float; the mask undoes the sign's extension.
    depth = depths.detach().contiguous().view(torch.int32).long()[owner] & 0xFFFFFFFF
    keys = (images[owner] << (32 + tiles.bit_length())) | (tile << 32) | depth
    ids, order = torch.sort(keys, stable=True)
    pairs = torch.bincount(images[owner] * tiles + tile, minlength=count * tiles)
    offsets = (pairs.cumsum(0) - pairs).int().view(count, rows, columns)
    return counts.int(), ids, owner[order].int(), offsets
