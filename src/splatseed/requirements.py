"""Optional packages: checking that they are installed, and how to install them."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from shlex import quote

from splatseed.errors import MissingDependencyError
from splatseed.literal import quoted

INSTALL = {
    "torch": "torch>=2.4",
    "gsplat": "gsplat>=1.5.3,<1.6",
    "torchmetrics": "torchmetrics>=1.4",
    "pandas": "pandas>=2.2",
    "pycolmap": "pycolmap>=4.0",
    "tensorboard": "tensorboard>=2.14",
    "transformers": "transformers>=5.18",
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
_TRAIN = ("torch", "gsplat", "torchmetrics", "pandas")
_EXTRA = {
    **dict.fromkeys(_TRAIN, "train"),
    "transformers": "depth",
    **dict.fromkeys(("viser", "zstandard", "imageio_ffmpeg"), "view"),
    **dict.fromkeys(("laspy", "lazrs", "pye57"), "scan"),
    "pycolmap": "sfm",
    "ray": "cluster",
    "OpenEXR": "exr",
    "tensorboard": "tensorboard",
}
"""The extra that a package is for, first of all, by the names in pyproject.toml."""
_TOGETHER = {
    "torch": _TRAIN,
    "gsplat": _TRAIN,
    "transformers": ("torch", "transformers"),
    "viser": ("viser", "imageio_ffmpeg", "zstandard"),
    "pycolmap": ("pycolmap", "imageio_ffmpeg"),
}
"""The packages of an extra by the one that is needed first, so that one command installs all."""
_TESTED = Path(__file__).parents[2] / "constraints.txt"
"""The versions that were tested; there only if splatseed runs from its own folder."""


def require(*packages: str) -> None:
    """Check that packages are installed, without importing them.

    Args:
        packages: Their names.

    Raises:
        MissingDependencyError: One is absent.
    """
    missing = [package for package in packages if find_spec(package) is None]
    if missing:
        extras = " and ".join(dict.fromkeys(_EXTRA[each] for each in missing))
        what = "it" if len(missing) == 1 else "them"
        advice = f"Install {what} (extra {extras}): {install_command(*missing)}."
        if "torch" in missing:
            advice += " On a machine without a GPU, PyTorch's CPU build suffices."
        raise MissingDependencyError(
            f"the package{'s' * (len(packages) > 1)} {', '.join(packages)}",
            found=f"no {', no '.join(missing)}",
            fix=advice,
        )


def install_command(*packages: str, upgrade: bool = False) -> str:
    """The command that installs packages, and what else their extra needs, for this Python.

    Args:
        packages: Names that ``INSTALL`` has.
        upgrade: Replace an older version.
    """
    wanted = dict.fromkeys(packages)
    for package in packages:
        others = _TOGETHER.get(package, ())
        wanted.update(dict.fromkeys(each for each in others if find_spec(each) is None))
    options = ["--upgrade"] if upgrade else []
    if _TESTED.is_file():
        options += ["-c", quoted(_TESTED)]
    words = ["install", *options, *(quote(INSTALL[w]) for w in wanted)]
    return f"{quoted(sys.executable or 'python')} -m pip {' '.join(words)}"
