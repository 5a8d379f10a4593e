"""Settings of a Structure-from-Motion run, and access to pycolmap.

Promise: a ``Settings`` that exists is valid, and pycolmap is imported only by ``require_pycolmap``.
"""

from __future__ import annotations

import importlib
import importlib.util
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

from splatseed.camera import CAMERA_MODELS
from splatseed.errors import MissingDependencyError, ParameterError
from splatseed.requirements import install_command

MatcherName: TypeAlias = Literal["exhaustive", "sequential"]
DeviceName: TypeAlias = Literal["auto", "cpu", "cuda"]

_OLDEST = 4  # the first to pose an image and its rig in one call
_MAX_SEED = 2**31 - 1  # pycolmap takes a 32-bit int


@dataclass(frozen=True)
class Settings:
    """How features are detected and matched, and how the scene is solved.

    Args:
        matcher: ``exhaustive`` compares every pair of images; ``sequential`` each with its
            successors in the order of names, for a video.
        device: Where features are detected and matched.
        max_image_size: Longer sides are reduced to this many pixels for feature detection.
        seed: Seed of RANSAC and of the order of bundle adjustment.
        threads: Worker threads; -1 = all cores.

    Raises:
        ParameterError: A value is out of its range.
    """

    matcher: MatcherName
    device: DeviceName
    max_image_size: int
    seed: int
    threads: int

    def __post_init__(self) -> None:
        _check_choice("matcher", self.matcher, get_args(MatcherName))
        _check_choice("device", self.device, get_args(DeviceName))
        _check_range("max_image_size", self.max_image_size, 1, _MAX_SEED)
        _check_range("seed", self.seed, 0, _MAX_SEED)
        if self.threads != -1:
            _check_range("threads", self.threads, 1, 4096)


def _advice() -> str:
    return f"Install it (extra sfm): {install_command('pycolmap', upgrade=True)}."


def check_installed() -> None:
    """Raise MissingDependencyError unless pycolmap is installed; does not import it."""
    if importlib.util.find_spec("pycolmap") is None:
        raise MissingDependencyError(
            "pycolmap to be installed", found="no such package", fix=_advice()
        )


def require_pycolmap() -> Any:
    """Import pycolmap.

    Raises:
        MissingDependencyError: It is absent, does not load, or is too old.
    """
    # pycolmap's wheel exports its own zlib. A system libz loaded after it binds to that and
    # corrupts the heap at the first compression (PNG, gzip); loaded before it, it does not.
    importlib.import_module("zlib")
    try:
        pycolmap = importlib.import_module("pycolmap")
    except (ImportError, RuntimeError) as error:  # RuntimeError: its C++ part does not load
        raise MissingDependencyError(
            "pycolmap to load", found=str(error).strip(), fix=_advice()
        ) from error
    if int(pycolmap.__version__.split(".")[0]) < _OLDEST:
        raise MissingDependencyError(
            f"pycolmap {_OLDEST} or newer", found=f"pycolmap {pycolmap.__version__}", fix=_advice()
        )
    return pycolmap


def check_cuda(pycolmap: Any, device: DeviceName) -> None:
    """Raise MissingDependencyError if ``device`` is cuda and this pycolmap cannot use it."""
    if device == "cuda" and not pycolmap.has_cuda:
        raise MissingDependencyError(
            "a pycolmap that can use CUDA, as device='cuda' asks",
            found=f"pycolmap {pycolmap.__version__} built for the CPU",
            fix="Use device='auto' or 'cpu', or install a CUDA build of pycolmap.",
        )


def check_camera_model(name: str) -> None:
    """Raise ParameterError unless ``name`` is one of COLMAP's camera models."""
    _check_choice("camera_model", name, tuple(CAMERA_MODELS))


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ParameterError(
            f"{name} to be one of {', '.join(choices)}",
            found=repr(value),
            fix=f"Choose one of them, for example {choices[0]!r}.",
        )


def _check_range(name: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise ParameterError(
            f"{name} between {low} and {high}", found=str(value), fix="Choose a value in between."
        )
