"""What training needs beyond the package's own requirements."""

from __future__ import annotations

from importlib.util import find_spec

from splatseed.errors import MissingDependencyError

__all__ = ["require"]

INSTALL = {
    "torch": "train",
    "gsplat": "train",
    "torchmetrics": "train",
    "tensorboard": "tensorboard",
}
"""Which extra of splatseed brings each package."""


def require(*packages: str) -> None:
    """Check that packages are installed, without importing them.

    Raises:
        MissingDependencyError: One is absent.
    """
    missing = [package for package in packages if find_spec(package) is None]
    if missing:
        extras = ",".join(sorted({INSTALL[package] for package in missing}))
        raise MissingDependencyError(
            f"the packages {', '.join(packages)}",
            found=f"no {', no '.join(missing)}",
            fix=f"Install them: pip install 'splatseed[{extras}]'. On a machine without a GPU,"
            " PyTorch's CPU build suffices.",
        )
