"""gsplat's MCMC strategy on either device.

Needs gsplat, unlike the rest of ``splatseed.render``, which imports it when it is first asked for.
"""

from __future__ import annotations

from typing import Any

import gsplat

from splatseed.render.relocation import mcmc_on_cpu

__all__ = ["MCMCStrategy"]


class MCMCStrategy(gsplat.MCMCStrategy):  # type: ignore[misc]  # gsplat has no types
    """gsplat's ``MCMCStrategy``, which moves and adds Gaussians, for CPU tensors too.

    Arguments, methods and results are gsplat's. Its own class runs CUDA kernels when it relocates,
    adds and shakes Gaussians; on CUDA tensors this one does so as well.

    Example:
        >>> from splatseed.render import MCMCStrategy
        >>> MCMCStrategy(cap_max=1000, verbose=True).cap_max
        1000
    """

    def step_post_backward(self, *args: Any, **kwargs: Any) -> None:
        """Do gsplat's step behind the optimisers; params, optimizers, state, step, info, lr."""
        with mcmc_on_cpu():
            super().step_post_backward(*args, **kwargs)
