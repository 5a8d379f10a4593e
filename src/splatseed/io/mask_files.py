"""Match mask files to photographs by name.

In a folder of masks, the mask of ``a/b.jpg`` is the first of ``a/b.jpg.png`` (COLMAP), ``a/b.png``
(nerfstudio), ``a/b.jpg.mask.png`` (RealityScan), ``a/b.mask.png`` (OpenMVS) and ``a/b_mask.png``
(3DGRUT), each also as JPEG, TIFF, WebP, BMP or GIF, and in any case; else such a file without the
subfolder, if the name is unique. The last three may also lie beside the photograph. A photograph of
the scene is never a mask.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from pathlib import Path, PurePosixPath

from splatseed.findings import Finding
from splatseed.io.files import IMAGE_SUFFIXES, files_below
from splatseed.text import agreeing, counted

FOLDER = "masks"
SUFFIXES = (*IMAGE_SUFFIXES, ".gif")
_FOLDERS = ("masks", "mask")
_MASK_LIKE = ("mask", "segment")
"""Parts of folder names that suggest masks of unknown polarity."""
_INVERTED = "dynamic_mask_"
"""Prefix of instant-ngp's masks, in which 0 marks valid pixels."""


def find_own_masks(
    names: Collection[str], image_dir: Path, root: Path
) -> tuple[dict[str, Path], list[Finding]]:
    """Find the masks near a folder of photographs, by photograph, with findings for the user."""
    alone = image_dir.absolute() != root.absolute()
    parents = [image_dir.parent, root, image_dir] if alone else [image_dir]
    folders = list(dict.fromkeys(each for parent in parents for each in _folders(parent)))
    known = [each for name in _FOLDERS for each in folders if each.name.casefold() == name]
    unused = list[Finding]()
    for folder in known:
        files, findings = find_masks(names, folder, image_dir)
        if files:
            return files, findings
        unused = unused or findings
    if files := _beside(names, image_dir):
        return files, unused
    for folder in folders:
        if folder not in known and (found := find_masks(names, folder, image_dir)[0]):
            text = (
                f"{folder} has pictures named like {counted(len(found), 'photograph')}, which are"
                f" not used: pass `masks={str(folder)!r}` if 0 means masked, or"
                f" `masks={f'inverted:{folder}'!r}` if 0 means valid."
            )
            unused.append(Finding("unused-masks", text))
    marked = {PurePosixPath(_dynamic(name)).name.casefold() for name in names}
    if dynamic := [path for path in _listing(names, image_dir) if path.stem.casefold() in marked]:
        text = (
            f"{counted(len(dynamic), 'mask')} of instant-ngp beside the photographs, such as"
            f" {dynamic[0].name}, are not used: pass `masks={f'inverted:{image_dir}'!r}` to use"
            " them."
        )
        unused.append(Finding("unused-masks", text))
    return {}, unused


def find_masks(
    names: Collection[str], folder: Path, image_dir: Path | None = None, *, named: bool = False
) -> tuple[dict[str, Path], list[Finding]]:
    """Find the masks in a folder by image name, and report masks and images that have no match.

    ``named``: the user chose the folder, so masks of instant-ngp are included.
    """
    is_own = image_dir is not None and folder.resolve() == image_dir.resolve()
    taken = set(names) if is_own else set()
    every = {path.relative_to(folder).as_posix(): path for path in files_below(folder)}
    there = {n: path for n, path in every.items() if _is_mask_file(n) and n not in taken}
    folded = {name.casefold(): path for name, path in reversed(there.items())}
    same = Counter(PurePosixPath(name).stem.casefold() for name in names)
    files, used = dict[str, Path](), set[Path]()
    for name in names:
        short = name.removeprefix("images/")  # names relative to the scene's folder
        stems = [*_mask_stems(short), *([_dynamic(short)] if named else [])]
        exact = (there.get(stem + suffix) for stem in stems for suffix in SUFFIXES)
        any_case = (folded.get((s + suffix).casefold()) for s in stems for suffix in SUFFIXES)
        path = next(filter(None, exact), None) or next(filter(None, any_case), None)
        if path is None and same[PurePosixPath(name).stem.casefold()] == 1:
            flat = ((PurePosixPath(s).name + suffix) for s in stems for suffix in SUFFIXES)
            path = next(filter(None, (folded.get(each.casefold()) for each in flat)), None)
        if path is not None:
            files[name] = path
            used.add(path)
    left = [] if is_own else [path for path in there.values() if path not in used]
    findings = _unmatched(names, files, left, folder)
    if not is_own:
        unmasked = [name for name in names if name not in files]
        findings += _unread(unmasked, every.keys() - there.keys())
    return files, findings


def _unread(unmasked: Collection[str], others: Collection[str]) -> list[Finding]:
    """Report files of other formats that are named as the masks of images without one."""
    stems = {stem.casefold() for name in unmasked for stem in _mask_stems(name)}
    found = sorted(other for other in others if _stem(other) in stems)
    if not found:
        return []
    which = (
        f"{counted(len(found), 'mask')}, such as {found[0]}, {agreeing(len(found), 'is', 'are')}"
    )
    text = f"{which} of a format that is not read: save masks as PNG."
    return [Finding("unread-masks", text, subjects=tuple(found))]


def _unmatched(
    names: Collection[str], files: Collection[str], left: list[Path], folder: Path
) -> list[Finding]:
    """Report masks without an image, and images without a mask if others have one."""
    parts = []
    if left:
        belong = f"{agreeing(len(left), 'belongs', 'belong')} to no image of the scene"
        such = left[0].relative_to(folder)
        parts.append(f"{counted(len(left), 'mask')} in {folder} {belong}, such as {such}")
    if files and (unmasked := [name for name in names if name not in files]):
        count, lack = counted(len(unmasked), "image"), agreeing(len(unmasked), "has", "have")
        where = "" if left else f" of {len(names)} with masks in {folder}"
        parts.append(f"{count}{where} {lack} no mask, such as {unmasked[0]}")
    return [Finding("unmatched-masks", f"{'; '.join(parts)}.")] if parts else []


def masks_among(names: Collection[str]) -> set[str]:
    """Return the names in a folder of photographs that are masks of others."""
    folders = {*_FOLDERS, "dynamic_masks", "segmentation"}
    inside = {n for n in names if {p.casefold() for p in PurePosixPath(n).parts[:-1]} & folders}
    inside = inside if len(inside) < len(names) else set()
    rest = [name for name in names if name not in inside]
    marked = {s.casefold() for n in rest for s in (*_mask_stems(n)[2:], _dynamic(n))}
    return inside | {n for n in rest if _stem(n) in marked and _is_mask_file(n)}


def _is_mask_file(name: str) -> bool:
    return PurePosixPath(name).suffix.lower() in SUFFIXES


def _stem(name: str) -> str:
    return PurePosixPath(name).with_suffix("").as_posix().casefold()


def _mask_stems(name: str) -> list[str]:
    """List possible mask paths without suffix; the first two apply only in a folder of masks."""
    stem = PurePosixPath(name).with_suffix("").as_posix()
    return [name, stem, f"{name}.mask", f"{stem}.mask", f"{stem}_mask"]


def _dynamic(name: str) -> str:
    """Return the path without suffix of a photograph's instant-ngp mask."""
    pure = PurePosixPath(name)
    return pure.with_name(f"{_INVERTED}{pure.stem}").as_posix()


def _listing(names: Collection[str], image_dir: Path) -> list[Path]:
    """List image files in the photographs' folders that are not photographs of the scene."""
    folders = sorted({(image_dir / name).parent for name in names})
    files = (f for folder in folders if folder.is_dir() for f in sorted(folder.iterdir()))
    taken = {image_dir / name for name in names}
    return [f for f in files if f.suffix.lower() in SUFFIXES and f not in taken]


def _beside(names: Collection[str], image_dir: Path) -> dict[str, Path]:
    """Find masks in the photographs' own folders."""
    there = {f.relative_to(image_dir).as_posix().casefold(): f for f in _listing(names, image_dir)}
    files = {}
    for name in names:
        marked = (s + suffix for s in _mask_stems(name)[2:] for suffix in SUFFIXES)
        if path := next((there[m.casefold()] for m in marked if m.casefold() in there), None):
            files[name] = path
    return files


def _folders(parent: Path) -> list[Path]:
    """List subfolders whose names suggest masks, ``masks`` first."""
    if not parent.is_dir():
        return []
    named = [
        each for each in parent.iterdir() if any(p in each.name.casefold() for p in _MASK_LIKE)
    ]
    return sorted((f for f in named if f.is_dir()), key=lambda f: (f.name != FOLDER, f.name))
