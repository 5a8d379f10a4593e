"""Which images train and which test, for scenes with files that say so.

Notation: a *list* is a text file with one image name per line. Promise: the first of these that
fits is used, and reported: ``train_filenames`` and ``test_filenames`` (else ``val_filenames``) of a
transforms.json, as nerfstudio writes them; ``train_list.txt``, ``test_list.txt`` (else
``validation_list.txt``) in the scene's folder, as nerfstudio's COLMAP reader has them; ``test.txt``
in the model's folder (graphdeco); ``train.txt`` and ``test.txt`` in the scene's. A list whose names
match no image is ignored, and reported too, as are single names that match none.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from splatseed.io.files import read_bytes
from splatseed.literal import agreeing, counted
from splatseed.scene import Scene, Split

ROOT_LISTS = ("train_list.txt", "test_list.txt", "validation_list.txt", "train.txt", "test.txt")
"""Lists in a scene's folder."""
MODEL_LISTS = ("test.txt",)
"""Lists beside a COLMAP model."""
_PARTS = ("train", "test", "val")
_SHOWN = 3
"""Names that a warning shows."""


class _Lists(NamedTuple):
    """Names for training, test and validation; empty where there is no list."""

    origin: str
    train: Sequence[str]
    test: Sequence[str]
    validation: Sequence[str] = ()


def follow_lists(scene: Scene) -> Scene:
    """The scene with the split of its lists, if it has some.

    Raises:
        SceneFormatError: A list cannot be read.
    """
    if scene.source is None or not scene.images or scene.listed is not None:
        return scene
    warnings = list(scene.warnings)
    for lists in _lists(scene):
        split, unknown = _split(scene, lists)
        if split is not None:
            if unknown:  # a slip, or lost by SfM
                shown = ", ".join(unknown[:_SHOWN]) + (", ..." if len(unknown) > _SHOWN else "")
                match = (
                    f"{counted(len(unknown), 'name')} {agreeing(len(unknown), 'matches', 'match')}"
                )
                warnings.append(f"{lists.origin}: {match} no image ({shown}).")
            return scene.replace(listed=split, warnings=tuple(warnings))
        warnings.append(
            f"{lists.origin} was ignored: it leaves no images to train on, or none to test."
        )
    return scene.replace(warnings=tuple(warnings))


def _lists(scene: Scene) -> Iterator[_Lists]:
    """All lists that a scene has, in order of precedence."""
    source = scene.source
    assert source is not None  # noqa: S101  (checked by the caller)
    if source.transforms_path is not None:
        fields = json.loads(read_bytes(source.transforms_path))
        parts = [_names(fields, f"{part}_filenames") for part in _PARTS]
        if any(parts):
            yield _Lists("list of file names in transforms.json", *parts)
    read = {name: _read(source.root / name) for name in ROOT_LISTS}
    if any(read[name] for name in ROOT_LISTS[:3]):
        there = " and ".join(name for name in ROOT_LISTS[:3] if read[name])
        yield _Lists(there, *(read[name] for name in ROOT_LISTS[:3]))
    if source.model_dir is not None and (names := _read(source.model_dir / MODEL_LISTS[0])):
        yield _Lists(f"{MODEL_LISTS[0]} beside the model", (), names)
    if any(read[name] for name in ROOT_LISTS[3:]):
        there = " and ".join(name for name in ROOT_LISTS[3:] if read[name])
        yield _Lists(there, read["train.txt"], read["test.txt"])


def _names(fields: Mapping[str, Any], key: str) -> list[str]:
    names = fields.get(key)
    return [each for each in names if isinstance(each, str)] if isinstance(names, list) else []


def _read(path: Path) -> list[str]:
    if not path.is_file():
        return []
    lines = read_bytes(path).decode("utf-8", "replace").splitlines()
    return [line.strip() for line in lines if line.strip()]


def _split(scene: Scene, lists: _Lists) -> tuple[Split | None, list[str]]:
    """The split of the images, None if one part would be empty; and the names of no image."""
    names = [image.name for image in scene.images]
    folder = scene.source.image_dir if scene.source else None
    prefixes = ("", "images/", f"{folder.name}/" if folder else "")
    known = [_known(names, each, prefixes) for each in lists[1:]]
    train, test, validation = (frozenset(each.values()) for each in known)
    used = (0, 1) if test or not validation else (0, 2)
    unknown = [name for i in used for name in lists[1 + i] if name not in known[i]]
    test = test or validation
    if lists.train and not lists.test and not lists.validation:
        test = frozenset(names) - train
    if not lists.train:
        train = frozenset(names) - test
    train -= test
    return (Split(train, test, lists.origin) if train and test else None), unknown


def _known(names: Sequence[str], listed: Sequence[str], prefixes: Sequence[str]) -> dict[str, str]:
    """The images that are listed: by name as it is or within their folder, or by file or stem."""
    exact = {f"{prefix}{name}": name for prefix in reversed(prefixes) for name in names}
    known = {each: exact[plain] for each in listed if (plain := _plain(each)) in exact}
    for field in () if known else ("name", "stem"):
        parts = {getattr(PurePosixPath(name), field): name for name in names}
        if len(parts) == len(names):  # else a name would be ambiguous
            wanted = {each: getattr(PurePosixPath(_plain(each)), field) for each in listed}
            known = {each: parts[part] for each, part in wanted.items() if part in parts}
        if known:
            break
    return known


def _plain(name: str) -> str:
    return name.replace("\\", "/").removeprefix("./")
