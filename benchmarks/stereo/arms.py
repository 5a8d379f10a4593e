"""Stereo with one choice undone: settings, or a copy of the package with some lines replaced.

Notation: an *edit* is a file of the package, a text in it and what takes its place. Promise: an
edit whose text does not stand exactly once in its file is an error, so that a renamed constant
cannot read as a choice that does not matter; the package itself is never written to, and compiled
code of a copy goes away with it.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.common.children import call

import splatseed

__all__ = ["ARMS", "FOLIAGE", "Arm", "apply_edits", "scores_of"]

PACKAGE = Path(splatseed.__file__).parent
COST, MATCH = "depth/stereo/_kernels/cost.py", "depth/stereo/_kernels/patchmatch.py"
START = "depth/stereo/matching.py"
THREADS = 2

Edit = tuple[str, str, str]


@dataclass(frozen=True)
class Arm:
    """What differs from the defaults."""

    settings: Mapping[str, Any] = field(default_factory=dict)
    edits: Sequence[Edit] = ()


MEAN_OF_ALL = (
    (COST, "lowest, second = broadcast(_WORST), broadcast(_WORST)", "lowest, second = broadcast(_ZERO), broadcast(_ZERO)"),  # noqa: E501  (the sources' own lines)
    (COST, "lowest, second = minimum(lowest, cost), minimum(second, higher)", "lowest = add(lowest, cost)"),  # noqa: E501  (the sources' own lines)
    (COST, "multiply(add(lowest, second), broadcast(_HALF))", "divide(lowest, broadcast(np.float32(len(sizes))))"),  # noqa: E501  (the sources' own lines)
)  # fmt: skip

ARMS: dict[str, Arm] = {
    "stereo": Arm(),
    "- 2 sweeps": Arm({"sweeps": 2}),
    "- 8 sweeps": Arm({"sweeps": 8}),
    "- 3 sources": Arm({"num_sources": 3}),
    "- 8 sources": Arm({"num_sources": 8}),
    "- mean of all sources": Arm(edits=MEAN_OF_ALL),
    "- no weights by colour": Arm(edits=[(COST, "SIGMA_GREY = 25.0", "SIGMA_GREY = 1e6")]),
    "- no weights at all": Arm(
        edits=[
            (COST, "SIGMA_GREY = 25.0", "SIGMA_GREY = 1e6"),
            (COST, "SIGMA_SPACE = 5.0", "SIGMA_SPACE = 1e6"),
        ]
    ),
    "- noise of 0.5": Arm(edits=[(COST, "NOISE = 0.1", "NOISE = 0.5")]),
    "- window at every pixel": Arm(edits=[(COST, "RADIUS, STRIDE = 2, 2", "RADIUS, STRIDE = 2, 1")]),  # noqa: E501  (the sources' own lines)
    "- window of 7 x 7": Arm(edits=[(COST, "RADIUS, STRIDE = 2, 2", "RADIUS, STRIDE = 3, 2")]),
    "- no slopes": Arm(
        edits=[
            (MATCH, "DEPTH_CHANGE, SLOPE_CHANGE = 0.02, 0.5", "DEPTH_CHANGE, SLOPE_CHANGE = 0.02, 0.0"),  # noqa: E501  (the sources' own lines)
            (START, "planes[num] = _fit_planes(", "planes[num] = 0 * _fit_planes("),
        ]
    ),
    "- slopes not refined": Arm(
        edits=[(MATCH, "DEPTH_CHANGE, SLOPE_CHANGE = 0.02, 0.5", "DEPTH_CHANGE, SLOPE_CHANGE = 0.02, 0.0")]  # noqa: E501  (the sources' own lines)
    ),
    "- no arms": Arm(edits=[(MATCH, "for direction in range(8):", "for direction in range(4):")]),
    "- start without the fitted plane": Arm(
        edits=[(START, "planes[num] = _fit_planes(", "planes[num] = 0 * _fit_planes(")]
    ),
    "- confirmed by 1": Arm({"min_agreeing": 1}),
    "- confirmed by 3": Arm({"min_agreeing": 3}),
    "- within 0.5%": Arm({"tolerance": 0.005}),
    "- within 2%": Arm({"tolerance": 0.02}),
}  # fmt: skip
"""A dash is the default with one choice undone."""

FOLIAGE: dict[str, Arm] = {
    "stereo": Arm(),
    "window at every pixel": Arm(edits=[(COST, "RADIUS, STRIDE = 2, 2", "RADIUS, STRIDE = 2, 1")]),
    "window of 7 x 7": Arm(edits=[(COST, "RADIUS, STRIDE = 2, 2", "RADIUS, STRIDE = 3, 2")]),
    "8 sources": Arm({"num_sources": 8}),
    "3 sources": Arm({"num_sources": 3}),
    "grid of 2": Arm({"grid": 2}),
    "grid of 1": Arm({"grid": 1}),
    "half size": Arm({"max_size": 400}),
    "8 sweeps": Arm({"sweeps": 8}),
    "cost up to 0.8": Arm({"max_cost": 0.8}),
    "confirmed by 1": Arm({"min_agreeing": 1}),
    "within 2%": Arm({"tolerance": 0.02}),
}
"""What might help where nothing is smooth."""


def scores_of(arm: Arm, function: str, **arguments: Any) -> dict[str, dict[str, float]]:
    """What a function of a module beside this file says of an arm, in a process of its own.

    Args:
        arm: Which.
        function: ``module:name``; it takes ``settings``.
        arguments: What else it takes.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment = {}
        if arm.edits:
            shutil.copytree(
                PACKAGE, Path(folder) / "splatseed", ignore=shutil.ignore_patterns("__pycache__")
            )
            apply_edits(Path(folder) / "splatseed", arm.edits)
            environment["PYTHONPATH"] = folder
        settings = dict(arm.settings)
        scores = call(
            function, threads=THREADS, environment=environment, settings=settings, **arguments
        )
    return dict(scores)


def apply_edits(package: Path, edits: Sequence[Edit]) -> None:
    """Replace lines of a copy of the package.

    Raises:
        ValueError: A text does not stand exactly once in its file.
    """
    for file, old, new in edits:
        text = (package / file).read_text(encoding="utf-8")
        if text.count(old) != 1:
            raise ValueError(f"{file} has {old!r} {text.count(old)} times, not once")
        (package / file).write_text(text.replace(old, new), encoding="utf-8")
