"""gsplat 1.5.3's compiled module in PyTorch: same names, checks, shapes and rules.

Inputs are checked as CHECK_INPUT does: on the GPU and contiguous; and their types.
"""

from __future__ import annotations

import sys
import types

import torch

from fake_projection import SEEN, Projection
from pretend_cuda import Pretend, check_input, elem


class _C(Projection):
    PINHOLE, ORTHO, FISHEYE, FTHETA = range(4)
    CameraModelType = types.SimpleNamespace(PINHOLE=0, ORTHO=1, FISHEYE=2, FTHETA=3)

    @staticmethod
    def rasterize_to_pixels_3dgs_fwd(
        means2d, conics, colors, opacities, backgrounds, masks, width, height, tile_size, offsets,
        flatten_ids,
    ):  # fmt: skip
        assert masks is None
        check_input(
            means2d=means2d, conics=conics, colors=colors, opacities=opacities,
            backgrounds=backgrounds,
        )  # fmt: skip
        check_input(torch.int32, offsets=offsets, flatten_ids=flatten_ids)
        dims = tuple(offsets.shape[:-2])
        with torch.no_grad():
            img, al = _blend(
                *_flat(means2d, conics, colors, opacities),
                _bg(backgrounds),
                width,
                height,
            )
        img, al = (
            img.reshape(*dims, height, width, -1).contiguous(),
            al.reshape(*dims, height, width, 1).contiguous(),
        )
        return (
            Pretend(img),
            Pretend(al),
            Pretend(torch.zeros(*dims, height, width, dtype=torch.int32)),
        )

    @staticmethod
    def rasterize_to_pixels_3dgs_bwd(
        means2d, conics, colors, opacities, backgrounds, masks, width, height, tile_size, offsets,
        flatten_ids, render_alphas, last_ids, v_colors, v_alphas, absgrad,
    ):  # fmt: skip
        check_input(
            means2d=means2d, conics=conics, colors=colors, opacities=opacities, v_colors=v_colors,
            v_alphas=v_alphas, render_alphas=render_alphas,
        )  # fmt: skip
        leaves = [x.clone().requires_grad_() for x in _flat(means2d, conics, colors, opacities)]
        with torch.enable_grad():
            img, al = _blend(
                *leaves,
                _bg(backgrounds),
                width,
                height,
            )
            g = torch.autograd.grad(
                [img, al],
                leaves,
                [elem(v_colors).reshape(img.shape), elem(v_alphas).reshape(al.shape)],
                allow_unused=True,
            )
        g = [torch.zeros_like(x) if y is None else y for x, y in zip(leaves, g, strict=False)]
        shapes = [t.shape for t in (means2d, conics, colors, opacities)]
        g = [Pretend(x.reshape(s).contiguous()) for x, s in zip(g, shapes, strict=False)]
        return (Pretend(elem(g[0]).abs()) if absgrad else None, *g)

    @staticmethod
    def spherical_harmonics_fwd(degree, dirs, coeffs, masks):
        check_input(dirs=dirs, coeffs=coeffs)
        check_input(torch.bool, masks=masks)
        from gsplat.cuda._torch_impl import _spherical_harmonics

        with torch.no_grad():
            out = _spherical_harmonics(degree, elem(dirs), elem(coeffs))
            if masks is not None:
                out = torch.where(elem(masks)[..., None], out, float("nan"))
        return Pretend(out.contiguous())

    @staticmethod
    def spherical_harmonics_bwd(num_bases, degree, dirs, coeffs, masks, v_colors, compute_v_dirs):
        check_input(dirs=dirs, coeffs=coeffs, v_colors=v_colors)
        from gsplat.cuda._torch_impl import _spherical_harmonics

        d, c = (elem(x).clone().requires_grad_() for x in (dirs, coeffs))
        with torch.enable_grad():
            out = _spherical_harmonics(degree, d, c)
            v = elem(v_colors)
            if masks is not None:
                v = torch.where(elem(masks)[..., None], v, 0.0)
            vd, vc = torch.autograd.grad(out, [d, c], v, allow_unused=True)
        vd = torch.zeros_like(d) if vd is None else vd
        if masks is not None:
            vd = torch.where(elem(masks)[..., None], vd, 0.0)
        return Pretend(vc.contiguous()), Pretend(vd.contiguous()) if compute_v_dirs else None

    @staticmethod
    def quat_scale_to_covar_preci_fwd(quats, scales, covar, preci, triu):
        check_input(quats=quats, scales=scales)
        from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci

        with torch.no_grad():
            a, b = _quat_scale_to_covar_preci(elem(quats), elem(scales), covar, preci, triu)
        return tuple(Pretend(x.contiguous() if x is not None else torch.empty(0)) for x in (a, b))

    @staticmethod
    def relocation(opacities, scales, ratios, binoms, n_max):
        check_input(opacities=opacities, scales=scales, binoms=binoms)
        check_input(torch.int32, ratios=ratios)
        from splatseed.render.mcmc import compute_relocation

        o, s = compute_relocation(elem(opacities), elem(scales), elem(ratios).long(), elem(binoms))
        return Pretend(o), Pretend(s)


def _blend(means2d, conics, colors, opac, bg, width, height):
    """Images and alphas with gradients; inputs are flat [M, ...].

    By splatseed's own kernels, not tile by tile: in milliseconds.
    """
    from splatseed.render.autograd import Blend

    radii, depths = SEEN
    assert radii.numel() == 2 * len(means2d), "one camera at a time"
    ok = (radii.reshape(-1, 2) > 0).all(-1)
    clean = [
        torch.where(ok.reshape(-1, *[1] * (x.dim() - 1)), x, 0.0)
        for x in (means2d, conics, colors, opac)
    ]
    img, al = Blend.apply(
        *clean,
        None if bg is None else bg[0],
        depths.reshape(-1),
        radii.reshape(-1, 2),
        width,
        height,
        None,
    )
    return img[None], al[None, ..., None]


def _flat(means2d, conics, colors, opacities):
    return (
        elem(means2d).reshape(-1, 2),
        elem(conics).reshape(-1, 3),
        elem(colors).reshape(-1, colors.shape[-1]),
        elem(opacities).reshape(-1),
    )


def _bg(backgrounds):
    return None if backgrounds is None else elem(backgrounds).reshape(-1, backgrounds.shape[-1])


def install():
    module = types.ModuleType("gsplat.cuda._backend")
    module._C = _C
    sys.modules["gsplat.cuda._backend"] = module
