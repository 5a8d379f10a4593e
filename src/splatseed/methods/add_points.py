"""``add_points``, the first step of ``ss.upsample``: a scene's originals, then one method's points.

Promise: the originals come first and unchanged; the same seed gives the same bytes whatever the
number of threads; new points are finite.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Mapping
from inspect import signature
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

from splatseed.errors import ParameterError, PointCloudError, SplatseedError
from splatseed.io.regions import Region
from splatseed.methods.contract import Made, Upsampler, nothing_finite, traits_of
from splatseed.methods.registry import chooses_number, plugin_fault, source_code
from splatseed.pointcloud import GENERATED, ORIGINAL, PointCloud
from splatseed.progress import Note, Progress, silent, silent_note
from splatseed.runtime.memory import check_memory
from splatseed.scene import Scene

if TYPE_CHECKING:
    from splatseed.depth.stereo.maps import StereoResult

DEFAULT_RATIO = 4.0
BYTES_EACH = 200  # memory per point while it is made and written; measured as 125 at 1 to 3 million
MAX_POINTS = 1 << 32  # a request for more points than this is a typo
_FIX = 'Correct the method (docs/methods.md, "Your own method").'


def add_points(
    scene: Scene,
    name: str,
    method: Upsampler,
    *,
    ratio: float | None = None,
    num_points: int | None = None,
    budget: int | None = None,
    region: Region | None = None,
    seed: int = 0,
    progress: Progress = silent,
    note: Note = silent_note,
    on_stereo: Callable[[StereoResult], None] | None = None,
) -> PointCloud:
    """Append the points of the method ``name`` to a scene's originals.

    With a region, a method that needs points alone starts from those within it; new points may
    still lie outside. Other arguments and errors are those of ``splatseed.upsample``.
    """
    originals = scene.points.originals
    num_new = number_of_new(method, name, scene, ratio, num_points, region)
    if region is not None and traits_of(method).needs == {"points"}:
        scene = scene.with_points(originals.select(region(originals.xyz)))
    if num_new == 0 and len(originals) > 0:
        return originals
    if "points" in traits_of(method).needs and not originals.finite.any():
        raise nothing_finite(len(originals))
    offered = {"note": note, "budget": budget, "region": region, "on_stereo": on_stereo}
    made = _call(
        name, method, (scene, num_new or 0, np.random.default_rng(seed), progress), offered
    )
    code = source_code(name) if _is_built_in(method) else GENERATED
    new = _as_cloud(name, made, num_new, len(originals), code)
    return PointCloud.concatenate(originals, new)


def _call(name: str, method: Any, arguments: tuple[Any, ...], offered: Mapping[str, Any]) -> Made:
    """Call a method, with those of the parameters ``offered`` that it has.

    An error of another package's method names the method and the line in its file.
    """
    try:
        parameters = signature(method).parameters
        made: Made = method(*arguments, **{k: v for k, v in offered.items() if k in parameters})
    except Exception as error:
        if _is_built_in(method) or isinstance(error, MemoryError):
            raise
        if not isinstance(error, SplatseedError):
            raise plugin_fault(method, name, error) from error
        file = getattr(sys.modules.get(getattr(method, "__module__", "")), "__file__", None)
        lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == file]
        where = f", line {lines[-1]} of {file}" if lines else ""
        expected = f"{error.expected}, in method {name!r}{where}"
        raise type(error)(expected, found=error.found, fix=error.fix) from error
    return made


def number_of_new(
    method: Upsampler,
    name: str,
    scene: Scene,
    ratio: float | None,
    num_points: int | None,
    region: Region | None = None,
) -> int | None:
    """Return the number of points to add to a scene's originals; None if the method chooses it.

    A ratio multiplies the originals in the region.

    Raises:
        ParameterError: A number is given for such a method, out of range or too large for memory.
    """
    originals = scene.points.originals
    num_original = len(originals)
    if region is not None and num_points is None:
        num_original = int(np.count_nonzero(region(originals.xyz)))
    if not chooses_number(method):
        suggest = getattr(method, "suggested_number", None)
        if suggest is not None and not num_original:
            suggested = suggest(scene)  # raises where the method cannot do without originals
            num_points = suggested if num_points is None and ratio is None else num_points
        total = planned_size(num_original, ratio, num_points)
        if total == 0 and "points" not in traits_of(method).needs:
            raise ParameterError(
                "`num_points` of 1 or more, as there are no originals for `ratio` to multiply",
                found="none" if num_points is None else f"{num_points}",
                fix="Pass `num_points`.",
            )
        fix = "Ask for {limit} in all, with `num_points` or a smaller `ratio`."
        check_memory(total, BYTES_EACH, "points", fix=fix)
        return total - num_original
    if ratio is not None or num_points is not None:
        given = f"`ratio={ratio!r}`" if ratio is not None else f"`num_points={num_points!r}`"
        raise ParameterError(
            f"no number of points for method {name!r}, which chooses it itself",
            found=given,
            fix="Drop it, pass `budget` to limit the number, or choose `method='mls'`.",
        )
    return None


def check_seed(seed: int) -> None:
    """Raise a ``ParameterError`` unless a random generator accepts the seed."""
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ParameterError(
            "a seed that is a whole number of 0 or more", found=repr(seed), fix="Choose another."
        )


def planned_size(num_original: int, ratio: float | None, num_points: int | None) -> int:
    """Return the number of points in all; raise a ``ParameterError`` if it is out of range."""
    if ratio is not None and num_points is not None:
        raise ParameterError(
            "`ratio` or `num_points`, not both", found="both", fix="Drop one of them."
        )
    if num_points is None:
        ratio = DEFAULT_RATIO if ratio is None else ratio
        if not isinstance(ratio, Real) or not 1 <= ratio < np.inf:
            raise ParameterError(
                "ratio of at least 1 (points in all, per original)",
                found=repr(ratio),
                fix="A ratio of 8 makes eight times as many points.",
            )
        num_points = round(min(float(ratio) * num_original, MAX_POINTS + 1))
    is_whole = isinstance(num_points, Real) and float(num_points).is_integer()  # also 1e6
    if not is_whole or num_points > MAX_POINTS:
        raise ParameterError(
            f"a whole number of points, {MAX_POINTS:,} at most",
            found=repr(num_points),
            fix="Ask for fewer." if is_whole else "Round it.",
        )
    num_points = int(num_points)
    if num_points < num_original:
        raise ParameterError(
            f"a number of points of at least the {num_original:,} originals",
            found=f"{num_points:,}",
            fix="Upsampling only adds points; ask for more.",
        )
    return num_points


def _is_built_in(method: Upsampler) -> bool:
    return getattr(method, "__module__", "").partition(".")[0] == "splatseed"


def _as_cloud(
    name: str, made: Made, num_new: int | None, num_original: int, code: int
) -> PointCloud:
    """Check the points that a method returned; ``num_new`` is None if it chose their number."""
    number, by = "M" if num_new is None else f"{num_new}", f"from method {name!r}"
    expected = (
        f"a PointCloud of {number} new points, or a tuple of their positions [{number}, 3] and "
        f"colours uint8 [{number}, 3], {by}"
    )
    points = made
    if not isinstance(points, PointCloud):
        if not isinstance(made, tuple | list):
            raise PointCloudError(expected, found=_describe(made), fix=_FIX)
        try:
            points = PointCloud(*made)
        except (SplatseedError, TypeError, ValueError) as error:
            raise PointCloudError(expected, found=_describe(made), fix=_FIX) from error
    if num_new is not None and len(points) != num_new:
        more = len(points) == num_new + num_original
        fix = f"{'Return the new points only, without the originals. ' * more}{_FIX}"
        raise PointCloudError(expected, found=_describe(made), fix=fix)
    if not np.isfinite(points.xyz).all():
        bad = int(np.flatnonzero(~np.isfinite(points.xyz).all(axis=1))[0])
        raise PointCloudError(
            f"finite new points {by}",
            found=f"{points.xyz[bad].tolist()} at new point {bad}",
            fix=f"{_FIX} Or float32 is too small for the coordinates of the scene.",
        )
    source = np.where(points.source == ORIGINAL, np.uint8(code), points.source)
    return points.replace(source=source, original_idx=None)


def _describe(made: Any) -> str:
    """Describe what a method returned: types, and shapes of arrays."""
    if isinstance(made, tuple):
        return f"a tuple of {', '.join(map(_describe, made[:4]))}{', ...' * (len(made) > 4)}"
    if isinstance(made, PointCloud):
        return f"a PointCloud of {len(made)}"
    if hasattr(made, "shape") and hasattr(made, "dtype"):
        return f"{made.dtype} {list(made.shape)}"
    return "None" if made is None else f"a {type(made).__name__}"
