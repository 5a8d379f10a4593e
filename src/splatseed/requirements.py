"""What parts of splatseed need beyond the package's own requirements."""

from __future__ import annotations

from importlib.util import find_spec

from splatseed.errors import MissingDependencyError

__all__ = ["require"]

INSTALL = {
    "torch": "train",
    "gsplat": "train",
    "torchmetrics": "train",
    "tensorboard": "tensorboard",
    "transformers": "depth",
    "onnxruntime": "depth",
    "OpenEXR": "exr",
    "ray": "cluster",
}
"""Which extra of splatseed brings each package."""


def require(*packages: str, extra: str | None = None) -> None:
    """Check that packages are installed, without importing them.

    Args:
        packages: Their names.
        extra: The extra of splatseed to advise, where several bring a package.

    Raises:
        MissingDependencyError: One is absent.
    """
    missing = [package for package in packages if find_spec(package) is None]
    if missing:
        extras = extra or ",".join(sorted({INSTALL[package] for package in missing}))
        advice = f"Install them: pip install 'splatseed[{extras}]'."
        if "torch" in missing:
            advice += " On a machine without a GPU, PyTorch's CPU build suffices."
        raise MissingDependencyError(
            f"the packages {', '.join(packages)}", found=f"no {', no '.join(missing)}", fix=advice
        )
