"""Photographs that the user leaves out of a scene, by names and patterns.

A pattern is a name, or has ``*``, ``?`` and ``[...]`` as in a shell. It applies to the whole name
of an image, relative to the folder of photographs, or to the file's own name, with or without its
suffix; ``*`` also matches ``/``. A path of a photograph names it, too. A text file (``.txt``) holds
one pattern per line.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath

from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io.depth_maps import DepthFiles
from splatseed.io.split import composed, read_names
from splatseed.scene import Scene
from splatseed.text import agreeing, counted, name_some

EXCLUDED = "excluded-photographs"
_SHOWN = 5
"""Names listed in messages."""


def exclude(scene: Scene, patterns: str | Sequence[str]) -> Scene:
    """Leave photographs out of a scene, and report how many; they become ``absent``.

    Patterns may match images that are absent already. Raises as ``matching_names``, and a
    ``ParameterError`` if no photograph is left.
    """
    if not patterns:
        return scene
    names = [image.name for image in scene.images]
    chosen = matching_names([*names, *scene.absent], patterns)
    present = [name for name in names if name in chosen]
    if len(present) == len(names):
        raise _nothing_left(len(names))
    if not present:
        return scene
    scene, depths = scene.without(present), scene.depths
    if isinstance(depths, DepthFiles):
        paths = {name: path for name, path in depths.paths.items() if name in scene}
        depths = replace(depths, paths=paths)
    findings = (*scene.findings, excluded_finding(present))
    return scene.replace(depths=depths, findings=findings)


def excluded_finding(names: Sequence[str]) -> Finding:
    """Return the finding on photographs that the user, or a run, leaves out."""
    are = agreeing(len(names), "is", "are")
    text = f"{counted(len(names), 'photograph')} {are} left out: "
    return Finding(EXCLUDED, f"{text}{name_some(names, _SHOWN)}.", "info", tuple(names))


def matching_names(names: Collection[str], patterns: str | Sequence[str]) -> frozenset[str]:
    """Return the names that match any of some patterns.

    Raises:
        ParameterError: A pattern matches none.
        SceneNotFoundError: There is no such text file.
    """
    chosen = set[str]()
    for pattern, origin in read_patterns(patterns):
        found = {pattern} & {*names} or {name for name in names if _matches(name, pattern)}
        if not found:
            raise ParameterError(
                f"`exclude` with names or patterns of photographs, such as "
                f"{name_some(sorted(names), _SHOWN) or 'none: there are none'}",
                found=f"{pattern!r}{origin}, which matches none of {len(names):,}",
                fix="Check its spelling; quote patterns, such as 'IMG_00*'.",
            )
        chosen |= found
    return frozenset(chosen)


def read_patterns(patterns: str | Sequence[str]) -> list[tuple[str, str]]:
    """Return patterns, those of text files included, and where each is from, for messages.

    Raises:
        SceneNotFoundError: There is no such text file.
    """
    found = list[tuple[str, str]]()
    for each in [patterns] if isinstance(patterns, str) else patterns:
        if Path(each).suffix.lower() != ".txt":
            found.append((each, ""))
            continue
        if not Path(each).is_file():
            fix = "Check the path."
            raise SceneNotFoundError(f"a text file of names at {each}", found="none", fix=fix)
        found += [(name, f" in {each}") for name in read_names(Path(each))]
    return found


def _matches(name: str, pattern: str) -> bool:
    name, pattern = composed(name), composed(pattern).replace("\\", "/")
    own = PurePosixPath(name)
    if f"/{pattern}".endswith(f"/{name}"):  # a path of the photograph
        return True
    return any(pattern == each or fnmatchcase(each, pattern) for each in (name, own.name, own.stem))


def _nothing_left(number: int) -> ParameterError:
    return ParameterError(
        "`exclude` to leave some photographs",
        found=f"patterns that match all {number:,}",
        fix="Name fewer.",
    )
