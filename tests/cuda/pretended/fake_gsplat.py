"""gsplat 1.5.3's compiled module by splatseed's kernels: its names, checks and shapes, one camera.

Inputs are checked as CHECK_INPUT does, on the GPU and contiguous, and their types. Outputs that the
kernels leave unwritten (culled Gaussians) are NaN, as at::empty may hold anything.
"""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace

import torch
from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci, _spherical_harmonics
from pretend_cuda import Pretend, check_input, elem, note

from splatseed.rendering.autograd import Blend, ProjectionParams, Project
from splatseed.rendering.mcmc import compute_relocation
from splatseed.rendering.rasterize import intersect

SEEN: list = [None, None]
"""Radii and depths of the last projection, which blending takes."""


def _pretend(*tensors):
    return tuple(None if each is None else Pretend(each.contiguous()) for each in tensors)


def _vjp(function, inputs, gradients):
    """The gradients by ``inputs`` of a function of CPU tensors."""
    leaves = [elem(each).clone().requires_grad_() for each in inputs]
    with torch.enable_grad():
        found = torch.autograd.grad(
            function(*leaves), leaves, list(map(elem, gradients)), allow_unused=True
        )
    pairs = zip(leaves, found, strict=True)
    return [torch.zeros_like(leaf) if each is None else each for leaf, each in pairs]


def _lens(Ks, width, height, near, far, eps2d, radius_clip, antialiased):
    K = elem(Ks)[0].numpy()
    return ProjectionParams(K, width, height, near, far, eps2d, radius_clip, antialiased)


def _blend(means2d, conics, colors, opacities, backgrounds, width, height):
    """Images and alphas, by splatseed's kernels: in milliseconds."""
    radii, depths = SEEN
    assert len(radii) == means2d.numel() // 2, "one camera at a time"
    flat = [
        torch.where((radii > 0).all(-1)[:, None], each.reshape(len(radii), -1), 0.0)
        for each in (means2d, conics, colors, opacities)
    ]
    behind = None if backgrounds is None else elem(backgrounds)[0]
    return Blend.apply(*flat[:3], flat[3][:, 0], behind, depths, radii, width, height, None)


class _C:
    PINHOLE, ORTHO, FISHEYE, FTHETA = range(4)
    CameraModelType = SimpleNamespace(PINHOLE=0, ORTHO=1, FISHEYE=2, FTHETA=3)

    @staticmethod
    def projection_ewa_3dgs_fused_fwd(
        means, covars, quats, scales, opacities, viewmats, Ks, width, height, eps2d, near, far,
        radius_clip, calc_compensations, camera_model,
    ):  # fmt: skip
        assert (covars, camera_model) == (None, 0)
        tensors = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
        check_input(**tensors, viewmats=viewmats, Ks=Ks)
        lens = _lens(Ks, width, height, near, far, eps2d, radius_clip, calc_compensations)
        with torch.no_grad():
            radii, *out = Project.apply(
                *map(elem, tensors.values()), elem(viewmats)[0], lens, False
            )
        culled = (radii == 0).any(-1)
        SEEN[:] = radii, torch.where(culled, 0.0, out[1])
        for each in out:
            each[culled] = torch.nan
        out = radii, *out[:3], out[3] if calc_compensations else None
        return _pretend(*(None if each is None else each[None] for each in out))

    @staticmethod
    def projection_ewa_3dgs_fused_bwd(
        means, covars, quats, scales, viewmats, Ks, width, height, eps2d, camera_model, radii,
        conics, compensations, *gradients_and_views,
    ):  # fmt: skip
        *gradients, of_views = gradients_and_views
        tensors = {"means": means, "quats": quats, "scales": scales, "viewmats": viewmats}
        check_input(**tensors, Ks=Ks, conics=conics)
        check_input(**{f"gradient {i}": each for i, each in enumerate(gradients)})
        check_input(torch.int32, radii=radii)
        saved = [*map(elem, (means, quats, scales)), elem(viewmats)[0]]
        lens = _lens(Ks, width, height, 0.0, 0.0, eps2d, 0.0, False)
        state = SimpleNamespace(
            saved_tensors=saved, params=lens, radii=elem(radii)[0].numpy(), sparse=False
        )
        if gradients[3] is None:
            gradients[3] = torch.zeros_like(gradients[1])
        with torch.no_grad():
            d_means, d_quats, d_scales, _, d_view, *_ = Project.backward(
                state, None, *(elem(each)[0] for each in gradients)
            )
        return _pretend(d_means, None, d_quats, d_scales, d_view[None] if of_views else None)

    @staticmethod
    def projection_ewa_3dgs_packed_fwd(*given):
        tensors = map(elem, _C.projection_ewa_3dgs_fused_fwd(*given))
        radii, *rest = (None if each is None else each[0] for each in tensors)
        rows = (radii > 0).all(-1).nonzero()[:, 0]
        SEEN[:] = (each[rows] for each in SEEN)
        note("packed: nnz")
        nothing = torch.zeros_like(rows)
        seen = (None if each is None else each[rows] for each in (radii, *rest))
        return _pretend(torch.zeros(1, dtype=torch.int32), nothing, nothing, rows, *seen)

    @staticmethod
    def intersect_tile(
        means2d, radii, depths, image_ids, gaussian_ids, images, size, columns, rows, *_
    ):
        check_input(means2d=means2d, depths=depths)
        check_input(torch.int32, radii=radii)
        check_input(torch.int64, image_ids=image_ids, gaussian_ids=gaussian_ids)
        flat = elem(means2d).view(-1, 2), elem(radii).view(-1, 2), elem(depths).flatten()
        owners = torch.zeros(len(flat[2]), dtype=torch.int64)
        note("isect: item")
        counts, ids, pairs, _ = intersect(*flat, owners, images, columns * size, rows * size, size)
        return _pretend(counts.view(depths.shape), ids, pairs)

    @staticmethod
    def intersect_offset(isect_ids, images, columns, rows):
        check_input(torch.int64, isect_ids=isect_ids)
        tiles = elem(isect_ids) >> 32  # of the only image
        first = torch.searchsorted(tiles, torch.arange(columns * rows))
        return Pretend(first.int().view(images, rows, columns))

    @staticmethod
    def rasterize_to_pixels_3dgs_fwd(
        means2d, conics, colors, opacities, backgrounds, masks, width, height, tile_size, offsets,
        flatten_ids,
    ):  # fmt: skip
        assert masks is None
        check_input(means2d=means2d, conics=conics, colors=colors, opacities=opacities)
        check_input(backgrounds=backgrounds)
        check_input(torch.int32, offsets=offsets, flatten_ids=flatten_ids)
        with torch.no_grad():
            image, alpha = _blend(
                *map(elem, (means2d, conics, colors, opacities)), backgrounds, width, height
            )
        last = torch.zeros(1, height, width, dtype=torch.int32)
        return _pretend(image[None], alpha[None, ..., None], last)

    @staticmethod
    def rasterize_to_pixels_3dgs_bwd(
        means2d, conics, colors, opacities, backgrounds, masks, width, height, tile_size, offsets,
        flatten_ids, render_alphas, last_ids, v_colors, v_alphas, absgrad,
    ):  # fmt: skip
        inputs = {"means2d": means2d, "conics": conics, "colors": colors, "opacities": opacities}
        check_input(**inputs, v_colors=v_colors, v_alphas=v_alphas, render_alphas=render_alphas)
        assert not absgrad
        gradients = _vjp(
            lambda *leaves: _blend(*leaves, backgrounds, width, height),
            inputs.values(), (v_colors[0], v_alphas[0, ..., 0]),
        )  # fmt: skip
        return None, *_pretend(*gradients)

    @staticmethod
    def spherical_harmonics_fwd(degree, dirs, coeffs, masks):
        check_input(dirs=dirs, coeffs=coeffs)
        check_input(torch.bool, masks=masks)
        with torch.no_grad():
            colors = _spherical_harmonics(degree, elem(dirs), elem(coeffs))
        live = True if masks is None else elem(masks)[..., None]
        return Pretend(torch.where(torch.as_tensor(live), colors, torch.nan).contiguous())

    @staticmethod
    def spherical_harmonics_bwd(num_bases, degree, dirs, coeffs, masks, v_colors, of_dirs):
        check_input(dirs=dirs, coeffs=coeffs, v_colors=v_colors)
        live = torch.as_tensor(True if masks is None else elem(masks)[..., None])
        d_dirs, d_coeffs = _vjp(
            lambda *leaves: torch.where(live, _spherical_harmonics(degree, *leaves), 0.0),
            (dirs, coeffs), (torch.where(live, elem(v_colors), 0.0),),
        )  # fmt: skip
        return _pretend(d_coeffs, torch.where(live, d_dirs, 0.0) if of_dirs else None)

    @staticmethod
    def quat_scale_to_covar_preci_fwd(quats, scales, covar, preci, triu):
        check_input(quats=quats, scales=scales)
        with torch.no_grad():
            found = _quat_scale_to_covar_preci(elem(quats), elem(scales), covar, preci, triu)
        return _pretend(*(torch.empty(0) if each is None else each for each in found))

    @staticmethod
    def relocation(opacities, scales, ratios, binoms, n_max):
        check_input(opacities=opacities, scales=scales, binoms=binoms)
        check_input(torch.int32, ratios=ratios)
        return _pretend(
            *compute_relocation(elem(opacities), elem(scales), elem(ratios).long(), elem(binoms))
        )


def install():
    """Let gsplat find this in place of its compiled module."""
    module = ModuleType("gsplat.cuda._backend")
    module._C = _C
    sys.modules[module.__name__] = module
