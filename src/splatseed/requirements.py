"""Check that optional packages are installed, and suggest how to install them."""

from __future__ import annotations

import platform
import re
import sys
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from shlex import quote

from splatseed.errors import MissingDependencyError
from splatseed.text import quoted

EXTRAS = {
    "train": (
        "torch>=2.5",
        "gsplat>=1.5.3,<1.6",
        "torchmetrics>=1.4",
        "flip-evaluator>=1.7",
        "pandas>=2.2",
        "jinja2>=3.1",
    ),
    "depth": ("torch>=2.5", "transformers>=5.18"),
    "view": ("viser>=1.1", "zstandard>=0.22", "imageio-ffmpeg>=0.6"),
    "scan": ("laspy>=2.5", "lazrs>=0.6", "pye57>=0.4.13"),
    "sfm": ("pycolmap>=4.0", "imageio-ffmpeg>=0.6"),
    "cluster": ("ray>=2.40",),
    "exr": ("OpenEXR>=3.3",),
    "r3d": ("lzfse>=0.4.2",),
    "tensorboard": ("tensorboard>=2.14",),
}
"""Requirements by extra, as in pyproject.toml; messages list them, since an extra can only be
installed from splatseed's folder. A package belongs to the first extra that has it."""
_CPU_BUILDS = "https://download.pytorch.org/whl/cpu"
_TESTED = Path(__file__).parents[2] / "constraints.txt"
"""The tested versions; absent unless splatseed runs from its own folder."""


def require(*packages: str) -> None:
    """Check that packages are installed; does not import them.

    Raises:
        MissingDependencyError: One is absent.
    """
    missing = [package for package in packages if find_spec(package) is None]
    if missing:
        extras = " and ".join(dict.fromkeys(map(_extra_of, missing)))
        what = "it" if len(missing) == 1 else "them"
        advice = f"Install {what} (extra {extras}): {install_command(*missing)}."
        if "torch" in missing:
            advice += " On a machine without a GPU, PyTorch's CPU build suffices: "
            advice += f"{install_command(*missing)} --extra-index-url {_CPU_BUILDS}."
        raise MissingDependencyError(
            f"the package{'s' * (len(packages) > 1)} {', '.join(packages)}",
            found=f"no {', no '.join(missing)}",
            fix=advice,
        )


def version_of(package: str) -> str | None:
    """Return the version of a package; None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


__version__ = version_of("splatseed") or "unknown"


def versions_of(packages: Iterable[str]) -> dict[str, str]:
    """Return the versions of Python and of those packages that are installed."""
    known = {package: found for package in packages if (found := version_of(package))}
    return {"python": platform.python_version(), **known}


def install_command(*packages: str, upgrade: bool = False) -> str:
    """Return the command that installs packages, and what else their extras lack, for this Python.

    Args:
        packages: Names of modules of ``EXTRAS``.
        upgrade: Replace an older version.
    """
    wanted: dict[str, None] = {}
    for each in packages:
        first, *others = sorted(EXTRAS[_extra_of(each)], key=lambda need: _module(need) != each)
        wanted |= dict.fromkeys([first, *(o for o in others if find_spec(_module(o)) is None)])
    options = ["--upgrade"] if upgrade else []
    options += ["-c", quoted(_TESTED)] if _TESTED.is_file() else []
    words = ["install", *options, *map(quote, wanted)]
    return pip_command(*words)


def pip_command(*words: str) -> str:
    """Return a command of this Python's own pip, such as "python -m pip uninstall NAME"."""
    return f"{quoted(sys.executable or 'python')} -m pip {' '.join(words)}"


def _module(requirement: str) -> str:
    return re.split("[<>=]", requirement)[0].replace("-", "_")


def _extra_of(package: str) -> str:
    return next(extra for extra, needs in EXTRAS.items() if package in map(_module, needs))
