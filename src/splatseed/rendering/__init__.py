"""Rasterise 3D Gaussians with gsplat's ``rasterization`` on any machine.

``rasterization`` has the signature and the results of ``gsplat.rasterization`` (1.5.3). CUDA
tensors go to gsplat itself; CPU tensors to this package's own rasteriser, so that code written for
gsplat runs, trains and is tested without a GPU. ``MCMCStrategy`` is gsplat's on either device, and
within ``mcmc_on_cpu`` gsplat's own class runs on the CPU. PyTorch is required; these two also need
gsplat (``pip install ".[train]"``).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from splatseed.requirements import require

require("torch")

from splatseed.rendering.rasterize import rasterization  # noqa: E402  (one clear error without torch)

if TYPE_CHECKING:
    from splatseed.rendering.mcmc import MCMCStrategy, mcmc_on_cpu

__all__ = ["MCMCStrategy", "mcmc_on_cpu", "rasterization"]


def __getattr__(name: str) -> Any:
    """Load the names that need gsplat.

    Raises:
        MissingDependencyError: gsplat is absent.
    """
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    require("gsplat")
    return getattr(import_module("splatseed.rendering.mcmc"), name)
