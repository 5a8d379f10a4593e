"""gsplat's MCMC strategy on either device.

Needs gsplat, unlike the rest of ``splatseed.render``, which imports it on demand.
"""

from __future__ import annotations

from typing import Any

import gsplat

from splatseed.render.relocation import mcmc_on_cpu


class MCMCStrategy(gsplat.MCMCStrategy):  # type: ignore[misc]  # gsplat has no types
    """gsplat's ``MCMCStrategy``, which relocates and adds Gaussians, for CPU tensors too.

    Arguments, methods and results are gsplat's. Its own class runs CUDA kernels to relocate, add
    and perturb Gaussians; for CUDA tensors this one does too.

    Example:
        >>> from splatseed.render import MCMCStrategy
        >>> MCMCStrategy(cap_max=1000, verbose=True).cap_max
        1000
    """

    def step_post_backward(self, *args: Any, **kwargs: Any) -> None:
        """Run gsplat's step after the optimisers; params, optimizers, state, step, info, lr."""
        with mcmc_on_cpu():
            super().step_post_backward(*args, **kwargs)
