"""Rasterisation of 3D Gaussians: gsplat's ``rasterization`` on any machine.

``rasterization`` has the signature and the results of ``gsplat.rasterization`` (1.5.3). CUDA
tensors go to gsplat itself; CPU tensors to this package's own rasteriser, so that code written for
gsplat runs, trains and is tested without a GPU. ``MCMCStrategy`` is gsplat's on either device, and
within ``mcmc_on_cpu`` gsplat's own class runs on the CPU. PyTorch is required; the strategy also
needs gsplat (``pip install ".[train]"``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from splatseed.errors import MissingDependencyError
from splatseed.requirements import install_command, require

try:
    import torch  # noqa: F401  (imported first, for one clear error if it is absent)
except ModuleNotFoundError as error:
    raise MissingDependencyError(
        "PyTorch for rendering and training",
        found="no module named 'torch'",
        fix=f"Install it (extra train): {install_command('torch')}.",
    ) from error

from splatseed.render.rasterize import rasterization
from splatseed.render.relocation import mcmc_on_cpu

if TYPE_CHECKING:
    from splatseed.render.mcmc import MCMCStrategy

__all__ = ["MCMCStrategy", "mcmc_on_cpu", "rasterization"]


def __getattr__(name: str) -> Any:
    """The names that need gsplat.

    Raises:
        MissingDependencyError: gsplat is absent.
    """
    if name != "MCMCStrategy":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    require("gsplat")
    from splatseed.render.mcmc import MCMCStrategy  # noqa: PLC0415  (imports gsplat)

    return MCMCStrategy
