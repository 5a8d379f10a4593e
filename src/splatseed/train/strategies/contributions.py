"""How much each Gaussian contributes to a photograph, and how wrong its pixels are.

Notation: w_ip is the weight of Gaussian i in pixel p, its alpha times the transmittance in front of
it, so that pixel p is sum_i w_ip c_i. Any rasteriser gives sums of weights as a gradient: of sum_p
f_p sum_i w_ip c_i with respect to c_i. Promise: the Gaussians and their gradients are left
unchanged.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from splatseed.splat.rendering import render_features
from splatseed.train.parameters import Parameters
from splatseed.views.view import View


def contributions(
    params: Parameters, view: View, error: Float[Tensor, "H W"]
) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"]]:
    """Each Gaussian's pixels, sum_p w_ip, and the error in them, sum_p w_ip e_p.

    Args:
        params: The parameter dict, in the frame of the view's camera.
        view: The view whose camera is used.
        error: The error e of each pixel.

    Returns:
        Pixels and errors; 0 where the view does not see a Gaussian.
    """
    means = params["means"]
    with torch.enable_grad():
        # Two channels of ones: their gradients are sum_p w_ip, plain or weighted by e_p.
        colors = means.new_ones((len(means), 2)).requires_grad_()
        frozen = {name: value.detach() for name, value in params.items()}
        plain, weighted = render_features(frozen, view, colors).unbind(-1)
        (plain.sum() + (weighted * error).sum()).backward()
    assert colors.grad is not None  # noqa: S101  (backward made it)
    pixels, errors = colors.grad.unbind(-1)
    return pixels, errors
