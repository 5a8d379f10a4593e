"""Train/test splits from files of a scene.

The first valid source is used: ``train_filenames`` and ``test_filenames`` (else
``val_filenames``) of a transforms.json, as in nerfstudio; or text files with one image name per
line, as in nerfstudio's COLMAP reader, graphdeco (beside the model) and others.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

from splatseed.findings import Finding
from splatseed.io.files import read_bytes, read_json
from splatseed.scene import Scene, Split
from splatseed.text import agreeing, counted

ROOT_LISTS = (
    *("train_list.txt", "test_list.txt", "val_list.txt", "validation_list.txt"),
    *("train.txt", "test.txt"),
)
"""Lists in a scene folder: training, test, validation (nerfstudio checks for the last name but
reads the one before); and training, test."""
MODEL_LISTS = ("test.txt",)
"""Lists beside a COLMAP model."""
_SHOWN = 3
"""Names listed in a warning."""


def with_listed_split(scene: Scene) -> Scene:
    """Set a scene's split from its lists, if it has any."""
    if not scene.images or scene.listed is not None:
        return scene
    findings = list(scene.findings)
    for origin, parts in _lists(scene):
        split, unmatched = _split(scene, origin, parts)
        unknown = [name for name in unmatched if name not in scene.absent]
        if split is not None:
            if unknown:  # typing errors, or images that SfM lost
                shown = ", ".join(unknown[:_SHOWN]) + (", ..." if len(unknown) > _SHOWN else "")
                match = agreeing(len(unknown), "matches", "match")
                names = counted(len(unknown), "name")
                text = f"{origin}: {names} {match} no image ({shown})."
                findings.append(Finding("unknown-names-in-split", text, subjects=tuple(unknown)))
            return scene.replace(listed=split, findings=tuple(findings))
        text = f"{origin} was ignored: it leaves no images to train on, or none to test."
        findings.append(Finding("unusable-split", text))
    return scene.replace(findings=tuple(findings))


def _lists(scene: Scene) -> Iterator[tuple[str, list[list[str]]]]:
    """Yield each list's description, and its names for training, test and maybe validation."""
    source = scene.source
    if source.transforms_path is not None:
        fields = read_json(source.transforms_path)
        found = [fields.get(f"{part}_filenames") for part in ("train", "test", "val")]
        parts = [[n for n in f if isinstance(n, str)] if isinstance(f, list) else [] for f in found]
        if any(parts):
            yield "list of file names in transforms.json", parts
    for folder, files, place in (
        (source.root, ROOT_LISTS[:4], ""),
        (source.model_dir, ("", *MODEL_LISTS), " beside the model"),
        (source.root, ROOT_LISTS[4:], ""),
    ):
        parts = [read_names(folder / name) if folder and name else [] for name in files]
        if any(parts):
            there = [name for name, part in zip(files, parts, strict=True) if part]
            first = f"{', '.join(there[:-1])} and " if there[1:] else ""
            yield f"{first}{there[-1]}{place}", parts


def read_names(path: Path) -> list[str]:
    """Read a list with one name per line; empty without such a file."""
    if not path.is_file():
        return []
    lines = read_bytes(path).decode("utf-8-sig", "replace").splitlines()
    return [line.strip() for line in lines if line.strip()]


def _split(scene: Scene, origin: str, parts: list[list[str]]) -> tuple[Split | None, list[str]]:
    """Make the split (None if a part is empty), and return names that match no image."""
    names = [image.name for image in scene.images]
    folder = scene.source.image_dir
    prefixes = ("", "images/", f"{folder.name}/" if folder else "")
    if len(parts) > 2 and not _known(names, parts[1], prefixes):
        parts = [parts[0], next(filter(None, parts[2:]), parts[1])]  # validation
    known = [_known(names, each, prefixes) for each in parts[:2]]
    train, test = (frozenset(each.values()) for each in known)
    unknown = [name for i in (0, 1) for name in parts[i] if name not in known[i]]
    if parts[0] and not parts[1]:
        test = frozenset(names) - train
    if not parts[0]:
        train = frozenset(names) - test
    train -= test
    return (Split(train, test, origin) if train and test else None), unknown


def _known(names: Sequence[str], listed: Sequence[str], prefixes: Sequence[str]) -> dict[str, str]:
    """Match listed names to images: by full or folder-relative name, else by file name or stem."""
    exact = {composed(f"{each}{name}"): name for each in reversed(prefixes) for name in names}
    plain = {each: composed(each).replace("\\", "/").removeprefix("./") for each in listed}
    known = {each: exact[name] for each, name in plain.items() if name in exact}
    for field in () if known else ("name", "stem"):
        parts = {getattr(PurePosixPath(composed(name)), field): name for name in names}
        if len(parts) == len(names):  # unless ambiguous
            wanted = {each: getattr(PurePosixPath(name), field) for each, name in plain.items()}
            known = {each: parts[part] for each, part in wanted.items() if part in parts}
        if known:
            break
    return known


def composed(name: str) -> str:
    """Return a name with one character per umlaut, however it is written."""
    return unicodedata.normalize("NFC", name)
