"""What gsplat 1.5.3's compiled module projects and sorts, in PyTorch: same names, checks and rules.

Outputs that the kernels leave unwritten (culled Gaussians) are NaN here, as at::empty may hold
anything.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from pretend_cuda import Pretend, _note, check_input, elem

ALPHA = 1.0 / 255.0
SEEN: list = [None, None]
"""Radii and depths of the last projection, which blending takes."""


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


class Projection:
    @staticmethod
    def projection_ewa_3dgs_fused_fwd(
        means, covars, quats, scales, opacities, viewmats, Ks, width, height, eps2d, near, far,
        radius_clip, calc_compensations, camera_model,
    ):  # fmt: skip
        assert covars is None
        assert camera_model == 0
        check_input(
            means=means, quats=quats, scales=scales, opacities=opacities, viewmats=viewmats, Ks=Ks
        )
        m, q, s, o, v, k = map(elem, (means, quats, scales, opacities, viewmats, Ks))
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
        means, covars, quats, scales, viewmats, Ks, width, height, eps2d, camera_model, radii,
        conics, compensations, v_means2d, v_depths, v_conics, v_compensations, viewmats_grad,
    ):  # fmt: skip
        check_input(
            means=means, quats=quats, scales=scales, viewmats=viewmats, Ks=Ks, conics=conics,
            v_means2d=v_means2d, v_depths=v_depths, v_conics=v_conics,
        )  # fmt: skip
        check_input(torch.int32, radii=radii)
        leaves = [elem(x).clone().requires_grad_() for x in (means, quats, scales, viewmats)]
        ok = (elem(radii) > 0).all(-1)
        with torch.enable_grad():
            means2d, depths, con, comp, _, _ = _project(*leaves, elem(Ks), width, height, eps2d)
            outs, grads = (
                [means2d[ok], depths[ok], con[ok]],
                [elem(v_means2d)[ok], elem(v_depths)[ok], elem(v_conics)[ok]],
            )
            if v_compensations is not None:
                outs.append(comp[ok])
                grads.append(elem(v_compensations)[ok])
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
    def projection_ewa_3dgs_packed_fwd(means, *given):
        assert means.dim() == 2
        radii, means2d, depths, conics, comp = map(
            elem, Projection.projection_ewa_3dgs_fused_fwd(means, *given)
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
        check_input(means2d=means2d, depths=depths)
        check_input(torch.int32, radii=radii)
        check_input(torch.int64, image_ids=image_ids, gaussian_ids=gaussian_ids)
        xy = elem(means2d).numpy().reshape(-1, 2)
        r = elem(radii).numpy().reshape(-1, 2)
        z = elem(depths).numpy().reshape(-1)
        ids = (
            np.repeat(np.arange(I), len(xy) // max(I, 1))
            if image_ids is None
            else elem(image_ids).numpy()
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
        check_input(torch.int64, isect_ids=isect_ids)
        bits = math.floor(math.log2(tw * th)) + 1
        key = elem(isect_ids).numpy() >> 32
        image, tile = key >> bits, key & ((1 << bits) - 1)
        flat = image * tw * th + tile
        off = np.searchsorted(flat, np.arange(I * tw * th))
        return Pretend(torch.from_numpy(off.astype(np.int32).reshape(I, th, tw)))
