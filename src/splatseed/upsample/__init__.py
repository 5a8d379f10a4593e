"""Upsampling: making more points from the existing ones.

``upsample`` takes a scene or a cloud, ``upsample_points`` bare arrays; ``METHODS`` has the methods.
Promise: the originals come first and unchanged; the same seed gives the same bytes whatever the
number of threads; new points are finite.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from numbers import Real
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32, UInt8

from splatseed.errors import ParameterError, PointCloudError
from splatseed.pointcloud import ATTRIBUTES, ORIGINAL, PointCloud
from splatseed.progress import Progress, silent
from splatseed.runtime.memory import check_memory
from splatseed.scene import Scene
from splatseed.upsample.method import Need, NewPoints, Traits, Upsampler, traits_of
from splatseed.upsample.registry import METHODS, source_code

__all__ = [
    "DEFAULT_RATIO",
    "METHODS",
    "NewPoints",
    "Profile",
    "Traits",
    "Upsampler",
    "as_cloud",
    "chooses_number",
    "configure",
    "methods_for",
    "number_of_new",
    "planned_size",
    "traits_of",
    "upsample",
    "upsample_points",
]

Profile = Literal["default", "paper"]
DEFAULT_RATIO = 4.0
BYTES_EACH = 200
"""Memory per point while it is made and written; measured as 125, from 1 to 3 million points."""
MAX_POINTS = 1 << 32
"""A request for more points than this is a typo."""


def configure(method: str, profile: Profile = "default", **parameters: Any) -> Upsampler:
    """An upsampling method with its parameters.

    Args:
        method: A key of ``METHODS``.
        profile: "default" avoids the paper's traps, "paper" follows its text to the letter.
        parameters: Fields of the method that differ from the profile's.

    Raises:
        ParameterError: No such method, profile or parameter, or a value out of range.

    Example:
        >>> configure("mls", "paper").k, configure("mls", k=12).k
        (10, 12)
    """
    kind = METHODS[method]
    if profile not in {"default", "paper"}:
        raise ParameterError(
            "the profile 'default' or 'paper'", found=repr(profile), fix="Choose one of these."
        )
    chosen: Any = getattr(kind, "paper", kind)() if profile == "paper" else kind()
    known = [f.name for f in dataclasses.fields(chosen)]
    for name in parameters:
        if name not in known:
            raise ParameterError(
                f"a parameter of {method} ({', '.join(known) or 'it has none'})",
                found=repr(name),
                fix="Check its spelling.",
            )
    configured: Upsampler = dataclasses.replace(chosen, **parameters)
    return configured


def chooses_number(method: str | Upsampler) -> bool:
    """Whether the photographs, not the caller, determine how many points a method makes."""
    return traits_of(configure(method) if isinstance(method, str) else method).chooses_number


def methods_for(scene: Scene | PointCloud) -> tuple[str, ...]:
    """The names of the methods for a scene: some need its depth maps, some its photographs.

    Example:
        >>> cloud = PointCloud(np.zeros((1, 3)), np.zeros((1, 3), np.uint8))
        >>> "depth" in METHODS, "depth" in methods_for(cloud)
        (True, False)
    """
    there: set[Need] = {"points"}
    if isinstance(scene, Scene) and scene.depths is not None:
        there.add("depth")
    if isinstance(scene, Scene) and scene.has_photographs:
        there.add("photographs")
    return tuple(name for name in METHODS if traits_of(configure(name)).needs <= there)


def upsample(
    scene: Scene | PointCloud,
    method: str | Upsampler = "mls",
    *,
    ratio: float | None = None,
    num_points: int | None = None,
    seed: int = 0,
    profile: Profile = "default",
    progress: Progress = silent,
    note: Callable[[str], None] = lambda _: None,
    **parameters: Any,
) -> PointCloud:
    """A scene's originals, then the new points of one method: step one of ``splatseed.upsample``.

    Arguments, errors and promises are those of that function; here the default method is ``mls``.

    Returns:
        The N originals, first and unchanged, then the new points; ``source`` tells them apart, and
        their attributes are those that the method provides.
    """
    whole = scene if isinstance(scene, Scene) else Scene(scene)
    originals = whole.points.originals
    chosen = _choose(method, profile, parameters)
    name = method if isinstance(method, str) else _name_of(chosen)
    num_new = number_of_new(chosen, name, len(originals), ratio, num_points)
    rng = _generator(seed)
    if num_new == 0 and len(originals) > 0:
        return originals
    if "points" in traits_of(chosen).needs and not originals.finite.any():
        raise PointCloudError(
            "at least one original point with finite coordinates",
            found=f"{len(originals)} points, none of them finite and original",
            fix="Check that the scene holds the point cloud you meant.",
        )
    new = NewPoints(*chosen(whole, num_new or 0, rng, progress))  # a plain tuple will do
    for sentence in new.notes:
        note(sentence)
    made = len(new.xyz) if num_new is None else num_new
    return PointCloud.concatenate(originals, as_cloud(new, made, source_code(name)))


def number_of_new(
    method: Upsampler,
    name: str,
    num_original: int,
    ratio: float | None,
    num_points: int | None,
) -> int | None:
    """How many points to make; None if the photographs determine it.

    Raises:
        ParameterError: A number is given though the photographs determine it, it is out of range,
            or so many points do not fit into memory.
    """
    if not chooses_number(method):
        total = planned_size(num_original, ratio, num_points)
        if total == 0 and "points" not in traits_of(method).needs:
            raise ParameterError(
                "num_points of 1 or more, as there are no originals that a ratio could multiply",
                found="none" if num_points is None else f"{num_points}",
                fix="Say how many.",
            )
        fix = "Ask for {most} in all, with --num-points or a smaller --ratio."
        check_memory(total, BYTES_EACH, "points", fix=fix)
        return total - num_original
    if ratio is not None or num_points is not None:
        raise ParameterError(
            f"no number of points for the method {name}, which the photographs determine",
            found="a ratio" if ratio is not None else "a number of points",
            fix="Leave it out, limit it with --budget, or choose --method mls.",
        )
    return None


def upsample_points(
    xyz: Float[np.ndarray, "N 3"],
    rgb: UInt8[np.ndarray, "N 3"],
    method: str | Upsampler = "mls",
    **options: Any,
) -> tuple[Float32[np.ndarray, "M 3"], UInt8[np.ndarray, "M 3"]]:
    """Arrays in, arrays out: ``upsample`` without a cloud around them.

    Args:
        xyz: Positions, [N, 3].
        rgb: Colours, uint8 [N, 3].
        method: As in ``upsample``.
        options: As in ``upsample``: ratio, num_points, seed, profile, parameters of the method.

    Returns:
        xyz float32 [M, 3] and rgb uint8 [M, 3]; the first N rows are the input.

    Raises:
        PointCloudError: The arrays' shapes or types do not fit, or there are too few points.
        ParameterError: As in ``upsample``.
    """
    seeds = upsample(PointCloud(xyz, rgb), method, **options)
    return seeds.xyz, seeds.rgb


def planned_size(num_original: int, ratio: float | None, num_points: int | None) -> int:
    """The number of points in all.

    Raises:
        ParameterError: Both are given, the ratio is below 1, or the number is not whole, below that
            of the originals or absurdly large.
    """
    if ratio is not None and num_points is not None:
        raise ParameterError(
            "either a ratio or a number of points", found="both", fix="Leave one of them out."
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
    if not isinstance(num_points, (int, np.integer)) or num_points > MAX_POINTS:
        raise ParameterError(
            f"a whole number of points, {MAX_POINTS:,} at most",
            found=repr(num_points),
            fix="Ask for fewer.",
        )
    if num_points < num_original:
        raise ParameterError(
            f"a number of points of at least the {num_original:,} originals",
            found=f"{num_points:,}",
            fix="Upsampling only adds points; ask for more.",
        )
    return num_points


def _choose(method: str | Upsampler, profile: Profile, parameters: dict[str, Any]) -> Upsampler:
    """The method to run; one that comes with its parameters takes no others."""
    if isinstance(method, str):
        return configure(method, profile, **parameters)
    extra = [*parameters, *(["profile"] if profile != "default" else [])]
    if extra:
        raise ParameterError(
            f"nothing beside {method!r}, which has its own parameters",
            found=", ".join(extra),
            fix="Give the method by name, or set its fields with dataclasses.replace.",
        )
    return method


def _generator(seed: int) -> np.random.Generator:
    """The source of all random numbers."""
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ParameterError(
            "a seed that is a whole number from 0", found=repr(seed), fix="Choose such a seed."
        )
    return np.random.default_rng(seed)


def as_cloud(new: NewPoints, num_new: int, code: int) -> PointCloud:
    """The new points with all attributes from their method; third parties' are checked, too.

    Args:
        new: What a method returned.
        num_new: How many points it was to make.
        code: Their ``source``, if the method gives none.

    Raises:
        PointCloudError: Points are not finite, arrays do not fit, or new points claim to be
            originals.
    """
    if not np.isfinite(new.xyz).all():
        bad = int(np.flatnonzero(~np.isfinite(new.xyz).all(axis=1))[0])
        raise PointCloudError(
            "finite new points",
            found=f"{new.xyz[bad].tolist()} at new point {bad}",
            fix="Report this with the scene; float32 may be too small for its coordinates.",
        )
    source = np.full(num_new, code, np.uint8) if new.source is None else np.asarray(new.source)
    if source.dtype != np.uint8 or (source == ORIGINAL).any():
        raise PointCloudError(
            "a uint8 source of new points, of codes from 1 to 255",
            found=f"{source.dtype}, {np.count_nonzero(source == ORIGINAL):,} with the originals' 0",
            fix="Leave the method's source out, or take codes of SOURCE_CODES.",
        )
    known = {name: getattr(new, name) for name in ATTRIBUTES}
    return PointCloud(new.xyz, new.rgb, source, **known)


def _name_of(method: Upsampler) -> str:
    """The registered name of a method instance, or its class name."""
    return next((n for n in METHODS if METHODS[n] is type(method)), type(method).__name__)
