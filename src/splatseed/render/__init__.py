"""Rasterisation of 3D Gaussians: gsplat's ``rasterization`` on any machine.

``rasterization`` has the signature and the results of ``gsplat.rasterization`` (1.5.3). CUDA tensors
go to gsplat itself; CPU tensors to this package's own rasteriser, so that code written for gsplat
runs, trains and is tested without a GPU. Needs PyTorch (``pip install "splatseed[train]"``).
"""

from splatseed.errors import MissingDependencyError

try:
    import torch  # noqa: F401  (asked for first, so that its absence is said once and plainly)
except ModuleNotFoundError as error:
    raise MissingDependencyError(
        "PyTorch for rendering and training",
        found="no module named 'torch'",
        fix='Install it with: pip install "splatseed[train]"',
    ) from error

from splatseed.render.rasterize import rasterization

__all__ = ["rasterization"]
