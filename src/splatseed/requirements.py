"""Optional packages: checking that they are installed, and how to install them."""

from __future__ import annotations

from importlib.util import find_spec
from shlex import quote

from splatseed.errors import MissingDependencyError

__all__ = ["INSTALL", "require"]

INSTALL = {
    "torch": "torch>=2.4",
    "gsplat": "gsplat>=1.5.3,<1.6",
    "torchmetrics": "torchmetrics>=1.4",
    "tensorboard": "tensorboard>=2.14",
    "transformers": "transformers>=5.18",
    "onnxruntime": "onnxruntime>=1.19",
    "OpenEXR": "OpenEXR>=3.3",
    "ray": "ray>=2.40",
    "imageio_ffmpeg": "imageio-ffmpeg>=0.6",
    "viser": "viser>=1.1",
    "zstandard": "zstandard>=0.22",
    "laspy": "laspy>=2.5",
    "lazrs": "lazrs>=0.6",
    "pye57": "pye57>=0.4.13",
}
"""What to ask pip for, as in pyproject.toml: splatseed's extras can only be installed from its
folder."""


def require(*packages: str) -> None:
    """Check that packages are installed, without importing them.

    Args:
        packages: Their names.

    Raises:
        MissingDependencyError: One is absent.
    """
    missing = [package for package in packages if find_spec(package) is None]
    if missing:
        advice = f"Install them: pip install {' '.join(quote(INSTALL[each]) for each in missing)}."
        if "torch" in missing:
            advice += " On a machine without a GPU, PyTorch's CPU build suffices."
        raise MissingDependencyError(
            f"the packages {', '.join(packages)}", found=f"no {', no '.join(missing)}", fix=advice
        )
