"""The words in which ``splatseed upsample`` says what it will do."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from splatseed.scene import Scene
from splatseed.seeding.photographs import Stereo, begins_from_points, has_points
from splatseed.upsample import Profile, Upsampler, configure

TOLD_ELSEWHERE = {"files", "transform", "memory", "alone"}
"""Parameters of a cloud that other lines tell."""


def parameters_of(method: Upsampler) -> dict[str, object]:
    """The parameters of a method by name; a cloud's files are told elsewhere."""
    given = dataclasses.asdict(method)  # type: ignore[call-overload]  # a method is a dataclass
    return {name: value for name, value in given.items() if name not in TOLD_ELSEWHERE}


def method_words(name: str, method: Upsampler, profile: Profile) -> str:
    """A method with what the user changed about it.

    Example:
        >>> method_words("mls", configure("mls", "paper", k=12), "paper")
        'mls (profile paper, k=12)'
    """
    plain = parameters_of(configure(name, profile))
    changed = [f"{k}={v}" for k, v in parameters_of(method).items() if v != plain[k]]
    words = [] if profile == "default" else [f"profile {profile}"]
    told = ", ".join([*words, *changed])
    return f"{name} ({told})" if told else name


def number_words(total: int | None, most: int | None, changed_by: Sequence[str] = ()) -> str:
    """How many points there will be.

    Args:
        total: Points in all; None if the photographs determine the number.
        most: The budget, if there is one.
        changed_by: Options that add points to the method's, or drop some of them.

    Example:
        >>> number_words(None, 50_000), number_words(800, 1000)
        ('at most 50,000 points', '800 points')
    """
    if most is not None and (total is None or total > most):
        return f"at most {most:,} points"
    if total is None:
        return "as many points as the photographs need"
    before = f" before {' and '.join(changed_by)}" if changed_by else ""
    return f"{total:,} points{before}"


def found_how(scene: Scene, method: Upsampler) -> str:
    """How a method that compares photographs finds depth without enough points; else empty.

    Args:
        scene: The scene.
        method: The method that makes its points.
    """
    if not isinstance(method, Stereo) or begins_from_points(scene):
        return ""
    points = "too few" if has_points(scene) else "no"
    where = "" if scene.depths is None else ", around its depth maps"
    return f": {points} points, so depth is found by comparing photographs{where}"
