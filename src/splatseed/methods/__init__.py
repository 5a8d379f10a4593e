"""Upsampling: making more points from the existing ones.

``upsample`` takes a scene or a cloud, ``upsample_points`` bare arrays; ``METHODS`` has the methods.
Promise: the originals come first and unchanged; the same seed gives the same bytes whatever the
number of threads; new points are finite.

METHODS has every method by name, imported when first looked up: first the built-in ones, then those
that installed packages register under the entry-point group ``splatseed.methods``
(``name = "package.module:Class"``). A built-in name cannot be overridden.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from numbers import Real
from typing import Any, Literal, cast

import numpy as np
from jaxtyping import Float, Float32, UInt8

from splatseed.errors import ParameterError, PointCloudError, UnknownNameError
from splatseed.methods.method import Need, NewPoints, Traits, Upsampler, nothing_finite, traits_of
from splatseed.pointcloud import ATTRIBUTES, GENERATED, ORIGINAL, PointCloud
from splatseed.progress import Progress, silent
from splatseed.runtime.memory import check_memory
from splatseed.scene import Scene

__all__ = [
    "DEFAULT_RATIO",
    "METHODS",
    "NewPoints",
    "Profile",
    "Traits",
    "Upsampler",
    "as_cloud",
    "check_seed",
    "chooses_number",
    "configure",
    "methods_for",
    "number_of_new",
    "planned_size",
    "traits_of",
    "upsample",
    "upsample_points",
]

GROUP = "splatseed.methods"

BUILT_IN = {
    "linear": "splatseed.methods.simplices:Linear",
    "triangle": "splatseed.methods.simplices:Triangle",
    "spline": "splatseed.methods.spline:Spline",
    "mls": "splatseed.methods.mls:Mls",
    "voronoi": "splatseed.methods.voronoi:Voronoi",
    "depth": "splatseed.methods.depth:Depth",
    "random": "splatseed.methods.bounding_box:BoundingBox",
    "stereo": "splatseed.seeding.photo_methods:Stereo",
    "cover": "splatseed.seeding.photo_methods:Cover",
    "auto": "splatseed.seeding.photo_methods:Auto",
    "cloud": "splatseed.seeding.clouds.method:Cloud",
}

_CODED = "linear triangle spline mls voronoi depth random stereo cover cloud"
SOURCE_CODES = {name: code for code, name in enumerate(_CODED.split(), start=1)}
"""The ``PointCloud.source`` code of each built-in method, which files keep."""


class MethodRegistry(Mapping[str, type[Upsampler]]):
    """The methods by name; a class is imported when it is first looked up."""

    def __getitem__(self, name: str) -> type[Upsampler]:
        if name in BUILT_IN:
            module, _, attribute = BUILT_IN[name].partition(":")
            return cast("type[Upsampler]", getattr(import_module(module), attribute))
        if name in self._plugins:
            return cast("type[Upsampler]", self._plugins[name].load())
        raise UnknownNameError(
            f"one of the methods {', '.join(self)}", found=repr(name), fix="Choose one of these."
        )

    def __contains__(self, name: object) -> bool:
        return name in BUILT_IN or name in self._plugins

    def __iter__(self) -> Iterator[str]:
        yield from BUILT_IN
        yield from self._plugins

    def __len__(self) -> int:
        return len(BUILT_IN) + len(self._plugins)

    @cached_property
    def _plugins(self) -> dict[str, EntryPoint]:
        return {
            entry.name: entry for entry in entry_points(group=GROUP) if entry.name not in BUILT_IN
        }


METHODS = MethodRegistry()


def source_code(name: str) -> int:
    """The ``PointCloud.source`` code of a method; 255 for every third-party method."""
    return SOURCE_CODES.get(name, GENERATED)


def origin_name(code: int) -> str:
    """The name of a ``PointCloud.source`` code."""
    names = {ORIGINAL: "original", **{code: name for name, code in SOURCE_CODES.items()}}
    return names.get(code, "other")


Profile = Literal["default", "paper"]
DEFAULT_RATIO = 4.0
BYTES_EACH = 200  # memory per point while it is made and written; measured as 125 at 1 to 3 million
MAX_POINTS = 1 << 32  # a request for more points than this is a typo


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
    if isinstance(method, str):
        chosen, name = configure(method, profile, **parameters), method
    elif extra := [*parameters, *(["profile"] if profile != "default" else [])]:
        raise ParameterError(
            f"nothing beside {method!r}, which has its own parameters",
            found=", ".join(extra),
            fix="Give the method by name, or set its fields with dataclasses.replace.",
        )
    else:
        chosen, kind = method, type(method)
        name = next((each for each in METHODS if METHODS[each] is kind), kind.__name__)
    num_new = number_of_new(chosen, name, len(originals), ratio, num_points)
    check_seed(seed)
    rng = np.random.default_rng(seed)
    if num_new == 0 and len(originals) > 0:
        return originals
    if "points" in traits_of(chosen).needs and not originals.finite.any():
        raise nothing_finite(len(originals))
    new = NewPoints(*chosen(whole, num_new or 0, rng, progress))  # a plain tuple will do
    for sentence in new.notes:
        note(sentence)
    made = len(new.xyz) if num_new is None else num_new
    return PointCloud.concatenate(originals, as_cloud(new, made, source_code(name)))


def number_of_new(
    method: Upsampler, name: str, num_original: int, ratio: float | None, num_points: int | None
) -> int | None:
    """How many points to make; None if the photographs determine it.

    A ``ParameterError``: they do and a number is given, or it is out of range or beyond the memory.
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

    The first N rows of the result are the input; method and options are those of ``upsample``.

    Raises:
        PointCloudError: The arrays' shapes or types do not fit, or there are too few points.
        ParameterError: As in ``upsample``.
    """
    seeds = upsample(PointCloud(xyz, rgb), method, **options)
    return seeds.xyz, seeds.rgb


def check_seed(seed: int) -> None:
    """Refuse what seeds no generator."""
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ParameterError(
            "a seed that is a whole number from 0", found=repr(seed), fix="Choose such a seed."
        )


def planned_size(num_original: int, ratio: float | None, num_points: int | None) -> int:
    """The number of points in all; a ``ParameterError`` if it cannot be, or both are given."""
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


def as_cloud(new: NewPoints, num_new: int, code: int) -> PointCloud:
    """What a method returned that was to make ``num_new`` points, checked (``PointCloudError``).

    ``code`` is their ``source``, if the method gives none.
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
