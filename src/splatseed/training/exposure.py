"""Training photographs of changing exposure or white balance: an affine colour transform of each.

Notation: E = (M, b) [3, 4] turns a render r into the photograph's colours, M r + b; E_0 = (I, 0).
At each step the photograph's E moves towards the least-squares fit of the current render to it,
before the Gaussians take their step. 3DGS learns the same transforms by gradients; a short run
shows each photograph too rarely for that. Promise: the mean of all E is E_0, so that the Gaussians
have the photographs' mean exposure; fits do not depend on the number of threads; a GPU is not
synchronised.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor
from torch.nn.functional import linear

PIXELS = 20_000
"""A fit of 12 numbers uses about this many pixels of a photograph, on a regular grid."""
RATE = 0.5
"""The fraction by which E moves towards a fit: the render changes until the next fit."""
RIDGE = 1e-3
"""Weight of |E - E_0|^2 relative to the mean squared error. Brightness, whose variance in a
photograph is about 0.05, follows the fit; colours that hardly vary, as hue in a grey scene,
stay."""
SATURATED = 1.5 / 255
"""Values of a photograph closer than this to 0 or 1 are excluded: they are clipped."""


class Exposures:
    """The transforms of the training photographs, in their order, changed in place."""

    def __init__(self, transforms: Float64[Tensor, "V 3 4"]) -> None:
        self.transforms = transforms

    @classmethod
    def identity(cls, count: int, device: torch.device) -> Exposures:
        """Return E_0 for each of ``count`` photographs."""
        return cls(_identity(device).repeat(count, 1, 1))

    @torch.no_grad()
    def fit(
        self,
        index: int,
        render: Float[Tensor, "H W 3"],
        photograph: Float[Tensor, "H W 3"],
        mask: Bool[Tensor, "H W"] | None = None,
    ) -> None:
        """Move a photograph's transform towards its fit, then all so that their mean is E_0."""
        height, width = photograph.shape[:2]
        step = max(1, round(math.sqrt(height * width / PIXELS)))
        x, y = (each[::step, ::step].reshape(-1, 3).T.double() for each in (render, photograph))
        known = ((y > SATURATED) & (y < 1 - SATURATED)).all(dim=0)
        if mask is not None:
            known &= mask[::step, ::step].reshape(-1)
        x = torch.cat([x, torch.ones_like(x[:1])]) * known
        weight, identity = RIDGE * len(known), _identity(x.device)
        # (X X^T + w I) E^T = X Y^T + w E_0^T; by sums, as BLAS's order depends on threads.
        gram = (x[:, None] * x).sum(dim=2) + weight * torch.eye(4, dtype=x.dtype, device=x.device)
        right = (x[:, None] * y).sum(dim=2) + weight * identity.T
        fitted = torch.linalg.solve_ex(gram, right).result.T
        self.transforms[index].lerp_(fitted, RATE)
        self.transforms += identity - self.transforms.mean(dim=0)

    def apply(self, index: int, render: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
        """Return the render at the photograph's exposure, M r + b, differentiably."""
        transform = self.transforms[index].to(render.dtype)
        return linear(render, transform[:, :3], transform[:, 3])

    def to_mean(self, index: int, photograph: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
        """Return the photograph at the mean exposure, M^-1 (p - b), clamped to [0, 1]."""
        transform = self.transforms[index]
        inverse = torch.linalg.inv_ex(transform[:, :3]).inverse
        offset = -(inverse @ transform[:, 3])
        corrected = linear(photograph, inverse.to(photograph.dtype), offset.to(photograph.dtype))
        return corrected.clamp_(0, 1).nan_to_num_()  # a black photograph's M may have no inverse


def _identity(device: torch.device) -> Float64[Tensor, "3 4"]:
    return torch.eye(3, 4, dtype=torch.float64, device=device)
