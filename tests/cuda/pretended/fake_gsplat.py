"""gsplat 1.5.3's compiled module in PyTorch: same names, checks, shapes and rules.

Outputs that the kernels leave unwritten (culled Gaussians) are NaN here, as at::empty may hold
anything.  Inputs are checked as CHECK_INPUT does: on the GPU and contiguous; and their types.
"""

from __future__ import annotations

import math
import sys
import types

import numpy as np
import torch

from pretend_cuda import Pretend, _note

ALPHA = 1.0 / 255.0
SEEN: list = [None, None]
CALLS: dict[str, int] = {}


def _input(dtype=torch.float32, **tensors):
    for name, t in tensors.items():
        if t is None:
            continue
        if not isinstance(t, Pretend):
            raise RuntimeError(f"{name} must be a CUDA tensor")
        if not t.is_contiguous():
            raise RuntimeError(f"{name} must be contiguous")
        if dtype is not None and t.dtype != dtype:
            raise RuntimeError(f"expected scalar type {dtype} but found {t.dtype} for {name}")


def _e(t):
    return t.elem.detach() if isinstance(t, Pretend) else t


def _project(means, quats, scales, viewmats, Ks, width, height, eps2d, camera="pinhole"):
    from gsplat.cuda._torch_impl import _persp_proj, _quat_scale_to_covar_preci, _world_to_cam

    covars, _ = _quat_scale_to_covar_preci(quats, scales, True, False, triu=False)
    means_c, covars_c = _world_to_cam(means, covars, viewmats)
    means2d, covars2d = _persp_proj(means_c, covars_c, Ks, width, height)
    det0 = covars2d[..., 0, 0] * covars2d[..., 1, 1] - covars2d[..., 0, 1] * covars2d[..., 1, 0]
    covars2d = covars2d + torch.eye(2) * eps2d
    det = covars2d[..., 0, 0] * covars2d[..., 1, 1] - covars2d[..., 0, 1] * covars2d[..., 1, 0]
    comp = torch.sqrt(torch.clamp(det0 / det, min=0.0))
    conics = torch.stack(
        [covars2d[..., 1, 1] / det, -covars2d[..., 0, 1] / det, covars2d[..., 0, 0] / det], -1
    )
    return means2d, means_c[..., 2], conics, comp, covars2d, det


class _C:
    PINHOLE, ORTHO, FISHEYE, FTHETA = range(4)
    CameraModelType = types.SimpleNamespace(PINHOLE=0, ORTHO=1, FISHEYE=2, FTHETA=3)

    @staticmethod
    def projection_ewa_3dgs_fused_fwd(
        means,
        covars,
        quats,
        scales,
        opacities,
        viewmats,
        Ks,
        width,
        height,
        eps2d,
        near,
        far,
        radius_clip,
        calc_compensations,
        camera_model,
    ):
        assert covars is None
        assert camera_model == 0
        _input(
            means=means, quats=quats, scales=scales, opacities=opacities, viewmats=viewmats, Ks=Ks
        )
        m, q, s, o, v, k = map(_e, (means, quats, scales, opacities, viewmats, Ks))
        with torch.no_grad():
            means2d, depths, conics, comp, cov, det = _project(m, q, s, v, k, width, height, eps2d)
            opac = o[..., None, :].expand(depths.shape)
            if calc_compensations:
                opac = opac * comp
            extend = torch.sqrt(2 * torch.log((opac / ALPHA).clamp(min=1.0))).clamp(max=3.33)
            radius = torch.ceil(
                extend[..., None] * torch.stack([cov[..., 0, 0], cov[..., 1, 1]], -1).sqrt()
            )
            ok = (depths >= near) & (depths <= far) & (det > 0) & (opac >= ALPHA)
            ok &= ~((radius <= radius_clip).all(-1))
            ok &= (means2d[..., 0] + radius[..., 0] > 0) & (
                means2d[..., 0] - radius[..., 0] < width
            )
            ok &= (means2d[..., 1] + radius[..., 1] > 0) & (
                means2d[..., 1] - radius[..., 1] < height
            )
            radii = torch.where(ok[..., None], radius, 0.0).int()
            nan = float("nan")
            SEEN[:] = radii, torch.where(ok, depths, 0.0)
            means2d = torch.where(ok[..., None], means2d, nan).contiguous()
            conics = torch.where(ok[..., None], conics, nan).contiguous()
            depths = torch.where(ok, depths, nan).contiguous()
            comp = torch.where(ok, comp, 0.0).contiguous() if calc_compensations else None
        return tuple(
            None if x is None else Pretend(x) for x in (radii, means2d, depths, conics, comp)
        )

    @staticmethod
    def projection_ewa_3dgs_fused_bwd(
        means,
        covars,
        quats,
        scales,
        viewmats,
        Ks,
        width,
        height,
        eps2d,
        camera_model,
        radii,
        conics,
        compensations,
        v_means2d,
        v_depths,
        v_conics,
        v_compensations,
        viewmats_grad,
    ):
        _input(
            means=means,
            quats=quats,
            scales=scales,
            viewmats=viewmats,
            Ks=Ks,
            conics=conics,
            v_means2d=v_means2d,
            v_depths=v_depths,
            v_conics=v_conics,
        )
        _input(torch.int32, radii=radii)
        leaves = [_e(x).clone().requires_grad_() for x in (means, quats, scales, viewmats)]
        ok = (_e(radii) > 0).all(-1)
        with torch.enable_grad():
            means2d, depths, con, comp, _, _ = _project(*leaves, _e(Ks), width, height, eps2d)
            outs, grads = (
                [means2d[ok], depths[ok], con[ok]],
                [_e(v_means2d)[ok], _e(v_depths)[ok], _e(v_conics)[ok]],
            )
            if v_compensations is not None:
                outs.append(comp[ok])
                grads.append(_e(v_compensations)[ok])
            g = torch.autograd.grad(outs, leaves, grads, allow_unused=True)
        g = [torch.zeros_like(x) if y is None else y for x, y in zip(leaves, g, strict=False)]
        # rows outside the near plane may have NaN from 0 * inf: the kernel never visits them
        seen = ok.any(-2)
        g = [
            torch.where(seen.reshape(seen.shape + (1,) * (x.dim() - seen.dim())), x, 0.0)
            if i < 3
            else x
            for i, x in enumerate(g)
        ]
        return (
            Pretend(g[0]),
            None,
            Pretend(g[1]),
            Pretend(g[2]),
            Pretend(g[3]) if viewmats_grad else None,
        )

    @staticmethod
    def projection_ewa_3dgs_packed_fwd(
        means,
        covars,
        quats,
        scales,
        opacities,
        viewmats,
        Ks,
        width,
        height,
        eps2d,
        near,
        far,
        radius_clip,
        calc_compensations,
        camera_model,
    ):
        assert means.dim() == 2
        radii, means2d, depths, conics, comp = map(
            _e,
            _C.projection_ewa_3dgs_fused_fwd(
                means,
                covars,
                quats,
                scales,
                opacities,
                viewmats,
                Ks,
                width,
                height,
                eps2d,
                near,
                far,
                radius_clip,
                calc_compensations,
                camera_model,
            ),
        )
        cam, gs = torch.where((radii > 0).all(-1))
        indptr = torch.zeros(1, dtype=torch.int32)
        _note("packed: nnz")
        out = (
            indptr,
            torch.zeros_like(cam),
            cam,
            gs,
            radii[cam, gs],
            means2d[cam, gs],
            depths[cam, gs],
            conics[cam, gs],
            None if comp is None else comp[cam, gs],
        )
        return tuple(None if x is None else Pretend(x.contiguous()) for x in out)

    @staticmethod
    def intersect_tile(
        means2d, radii, depths, image_ids, gaussian_ids, I, tile_size, tw, th, sort, segmented
    ):
        _input(means2d=means2d, depths=depths)
        _input(torch.int32, radii=radii)
        _input(torch.int64, image_ids=image_ids, gaussian_ids=gaussian_ids)
        xy = _e(means2d).numpy().reshape(-1, 2)
        r = _e(radii).numpy().reshape(-1, 2)
        z = _e(depths).numpy().reshape(-1)
        ids = (
            np.repeat(np.arange(I), len(xy) // max(I, 1))
            if image_ids is None
            else _e(image_ids).numpy()
        )
        ok = np.flatnonzero((r > 0).all(1))
        lo = np.floor((xy[ok] - r[ok]) / tile_size).clip(0, [tw, th]).astype(int)
        hi = np.ceil((xy[ok] + r[ok]) / tile_size).clip(0, [tw, th]).astype(int)
        n = (hi - lo).prod(1)
        tiles = np.zeros(len(xy), np.int32)
        tiles[ok] = n
        _note("isect: item")
        which = np.repeat(np.arange(len(ok)), n)
        k = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
        w = (hi - lo)[which, 0]
        x, y = lo[which, 0] + k % w, lo[which, 1] + k // w
        bits = math.floor(math.log2(tw * th)) + 1
        key = (ids[ok][which].astype(np.int64) << (32 + bits)) | (
            (y * tw + x).astype(np.int64) << 32
        )
        key |= z[ok][which].astype(np.float32).view(np.uint32).astype(np.int64)
        order = np.argsort(key, kind="stable") if sort else slice(None)
        return (
            Pretend(torch.from_numpy(tiles.reshape(tuple(depths.shape)))),
            Pretend(torch.from_numpy(key[order])),
            Pretend(torch.from_numpy(ok[which][order].astype(np.int32))),
        )

    @staticmethod
    def intersect_offset(isect_ids, I, tw, th):
        _input(torch.int64, isect_ids=isect_ids)
        bits = math.floor(math.log2(tw * th)) + 1
        key = _e(isect_ids).numpy() >> 32
        image, tile = key >> bits, key & ((1 << bits) - 1)
        flat = image * tw * th + tile
        off = np.searchsorted(flat, np.arange(I * tw * th))
        return Pretend(torch.from_numpy(off.astype(np.int32).reshape(I, th, tw)))

    @staticmethod
    def _blend(means2d, conics, colors, opac, bg, width, height, tile, offsets, ids):
        """Images and alphas with gradients; inputs are flat [M, ...]."""
        # One camera is blended by splatseed's own kernels, not tile by tile: in milliseconds.
        if len(offsets) == 1 and SEEN[0].numel() == 2 * len(means2d):
            from splatseed.render.autograd import Blend

            ok = (SEEN[0].reshape(-1, 2) > 0).all(-1)
            clean = [
                torch.where(ok.reshape(-1, *[1] * (x.dim() - 1)), x, 0.0)
                for x in (means2d, conics, colors, opac)
            ]
            img, al = Blend.apply(
                *clean,
                None if bg is None else bg[0],
                SEEN[1].reshape(-1),
                SEEN[0].reshape(-1, 2),
                width,
                height,
                None,
            )
            return img[None], al[None, ..., None]
        I, th, tw = offsets.shape
        ends = torch.cat([offsets.reshape(-1)[1:], torch.tensor([len(ids)], dtype=offsets.dtype)])
        rows = []
        for i in range(I):
            tiles = []
            for t in range(th * tw):
                a, b = int(offsets.reshape(-1)[i * th * tw + t]), int(ends[i * th * tw + t])
                g = ids[a:b].long()
                y0, x0 = (t // tw) * tile, (t % tw) * tile
                ys, xs = torch.meshgrid(
                    torch.arange(y0, y0 + tile) + 0.5,
                    torch.arange(x0, x0 + tile) + 0.5,
                    indexing="ij",
                )
                px = torch.stack([xs.reshape(-1), ys.reshape(-1)], -1)
                d = means2d[g][None] - px[:, None]
                c = conics[g]
                sigma = (
                    0.5 * (c[:, 0] * d[..., 0] ** 2 + c[:, 2] * d[..., 1] ** 2)
                    + c[:, 1] * d[..., 0] * d[..., 1]
                )
                alpha = torch.clamp_max(opac[g] * torch.exp(-sigma), 0.999)
                keep = (sigma >= 0) & (alpha >= ALPHA)
                alpha = torch.where(keep, alpha, 0.0)
                after = torch.cumprod(1 - alpha, 1)
                before = torch.cat([torch.ones(len(px), 1), after[:, :-1]], 1) if len(g) else after
                use = after > 1e-4
                w = torch.where(use, alpha * before, 0.0)
                T = 1 - w.sum(1)
                img = w @ colors[g]
                if bg is not None:
                    img = img + T[:, None] * bg[i]
                tiles.append((img, 1 - T))
            img = (
                torch.stack([x for x, _ in tiles])
                .reshape(th, tw, tile, tile, -1)
                .permute(0, 2, 1, 3, 4)
            )
            al = (
                torch.stack([x for _, x in tiles])
                .reshape(th, tw, tile, tile, 1)
                .permute(0, 2, 1, 3, 4)
            )
            rows.append(
                (
                    img.reshape(th * tile, tw * tile, -1)[:height, :width],
                    al.reshape(th * tile, tw * tile, 1)[:height, :width],
                )
            )
        return torch.stack([x for x, _ in rows]), torch.stack([x for _, x in rows])

    @staticmethod
    def rasterize_to_pixels_3dgs_fwd(
        means2d,
        conics,
        colors,
        opacities,
        backgrounds,
        masks,
        width,
        height,
        tile_size,
        offsets,
        flatten_ids,
    ):
        assert masks is None
        _input(
            means2d=means2d,
            conics=conics,
            colors=colors,
            opacities=opacities,
            backgrounds=backgrounds,
        )
        _input(torch.int32, offsets=offsets, flatten_ids=flatten_ids)
        dims = tuple(offsets.shape[:-2])
        with torch.no_grad():
            img, al = _C._blend(
                *_flat(means2d, conics, colors, opacities),
                _bg(backgrounds),
                width,
                height,
                tile_size,
                _e(offsets).reshape(-1, *offsets.shape[-2:]),
                _e(flatten_ids),
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
        means2d,
        conics,
        colors,
        opacities,
        backgrounds,
        masks,
        width,
        height,
        tile_size,
        offsets,
        flatten_ids,
        render_alphas,
        last_ids,
        v_colors,
        v_alphas,
        absgrad,
    ):
        _input(
            means2d=means2d,
            conics=conics,
            colors=colors,
            opacities=opacities,
            v_colors=v_colors,
            v_alphas=v_alphas,
            render_alphas=render_alphas,
        )
        leaves = [x.clone().requires_grad_() for x in _flat(means2d, conics, colors, opacities)]
        with torch.enable_grad():
            img, al = _C._blend(
                *leaves,
                _bg(backgrounds),
                width,
                height,
                tile_size,
                _e(offsets).reshape(-1, *offsets.shape[-2:]),
                _e(flatten_ids),
            )
            g = torch.autograd.grad(
                [img, al],
                leaves,
                [_e(v_colors).reshape(img.shape), _e(v_alphas).reshape(al.shape)],
                allow_unused=True,
            )
        g = [torch.zeros_like(x) if y is None else y for x, y in zip(leaves, g, strict=False)]
        shapes = [t.shape for t in (means2d, conics, colors, opacities)]
        g = [Pretend(x.reshape(s).contiguous()) for x, s in zip(g, shapes, strict=False)]
        return (Pretend(_e(g[0]).abs()) if absgrad else None, *g)

    @staticmethod
    def spherical_harmonics_fwd(degree, dirs, coeffs, masks):
        _input(dirs=dirs, coeffs=coeffs)
        _input(torch.bool, masks=masks)
        from gsplat.cuda._torch_impl import _spherical_harmonics

        with torch.no_grad():
            out = _spherical_harmonics(degree, _e(dirs), _e(coeffs))
            if masks is not None:
                out = torch.where(_e(masks)[..., None], out, float("nan"))
        return Pretend(out.contiguous())

    @staticmethod
    def spherical_harmonics_bwd(num_bases, degree, dirs, coeffs, masks, v_colors, compute_v_dirs):
        _input(dirs=dirs, coeffs=coeffs, v_colors=v_colors)
        from gsplat.cuda._torch_impl import _spherical_harmonics

        d, c = (_e(x).clone().requires_grad_() for x in (dirs, coeffs))
        with torch.enable_grad():
            out = _spherical_harmonics(degree, d, c)
            v = _e(v_colors)
            if masks is not None:
                v = torch.where(_e(masks)[..., None], v, 0.0)
            vd, vc = torch.autograd.grad(out, [d, c], v, allow_unused=True)
        vd = torch.zeros_like(d) if vd is None else vd
        if masks is not None:
            vd = torch.where(_e(masks)[..., None], vd, 0.0)
        return Pretend(vc.contiguous()), Pretend(vd.contiguous()) if compute_v_dirs else None

    @staticmethod
    def quat_scale_to_covar_preci_fwd(quats, scales, covar, preci, triu):
        _input(quats=quats, scales=scales)
        from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci

        with torch.no_grad():
            a, b = _quat_scale_to_covar_preci(_e(quats), _e(scales), covar, preci, triu)
        return tuple(Pretend(x.contiguous() if x is not None else torch.empty(0)) for x in (a, b))

    @staticmethod
    def relocation(opacities, scales, ratios, binoms, n_max):
        _input(opacities=opacities, scales=scales, binoms=binoms)
        _input(torch.int32, ratios=ratios)
        from splatseed.render.relocation import compute_relocation

        o, s = compute_relocation(_e(opacities), _e(scales), _e(ratios).long(), _e(binoms))
        return Pretend(o), Pretend(s)


def _flat(means2d, conics, colors, opacities):
    return (
        _e(means2d).reshape(-1, 2),
        _e(conics).reshape(-1, 3),
        _e(colors).reshape(-1, colors.shape[-1]),
        _e(opacities).reshape(-1),
    )


def _bg(backgrounds):
    return None if backgrounds is None else _e(backgrounds).reshape(-1, backgrounds.shape[-1])


def install():
    module = types.ModuleType("gsplat.cuda._backend")
    module._C = _C
    sys.modules["gsplat.cuda._backend"] = module
