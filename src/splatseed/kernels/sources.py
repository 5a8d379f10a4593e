"""The source files that a compiled function may be built from, and a digest of their contents.

Notation: a file *reaches* another file of its own package, or of splatseed, through the imports at
its top, directly or through other files. Indented imports, such as those for annotations, do not
count.
Promise: the digest depends on the contents of these files and on nothing else, neither their dates
nor their location: two checkouts of one commit have the same.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple, TypeAlias

Packages: TypeAlias = tuple[tuple[str, Path], ...]
"""Names and folders of the packages whose files count."""

SPLATSEED = ("splatseed", Path(__file__).parents[1])
IMPORT = re.compile(
    rb"^(?:from (?P<dots>\.*)(?P<module>[\w.]*) import (?P<names>\([^)]*\)|.*)"
    rb"|import (?P<whole>[\w.]+))",
    re.MULTILINE,
)


def source_digest(path: Path, module: str) -> str:
    """The SHA-256 of a file and of everything it reaches, in hexadecimal.

    Args:
        path: A Python file.
        module: Its dotted name.

    Raises:
        OSError: A file cannot be read.
    """
    total = hashlib.sha256()
    for digest in sorted(source.digest for source in _reach(path, module).values()):
        total.update(digest)
    return total.hexdigest()


def reached_files(path: Path, module: str) -> frozenset[Path]:
    """A file and everything it reaches.

    Args:
        path: A Python file.
        module: Its dotted name.

    Raises:
        OSError: A file cannot be read.
    """
    return frozenset(_reach(path, module))


class _Source(NamedTuple):
    """What is read from a file: the digest of its contents, and the files that it imports."""

    digest: bytes
    imports: tuple[Path, ...]


def _reach(path: Path, module: str) -> dict[Path, _Source]:
    packages: Packages = tuple({**dict(_own_package(path, module)), **dict([SPLATSEED])}.items())
    sources: dict[Path, _Source] = {}
    waiting = [path]
    while waiting:
        each = waiting.pop()
        if each not in sources:
            status = each.stat()
            sources[each] = _read(each, packages, status.st_mtime_ns, status.st_size)
            waiting.extend(sources[each].imports)
    return sources


def _own_package(path: Path, module: str) -> Packages:
    """The package that a file belongs to; none if it is a script."""
    depth = module.count(".") + (path.name == "__init__.py")
    return ((module.partition(".")[0], path.parents[depth - 1]),) if depth else ()


@cache
def _read(path: Path, packages: Packages, mtime_ns: int, size: int) -> _Source:  # noqa: ARG001  (part of the cache's key)
    """Cached: a file is read again only if its date or size has changed."""
    text = path.read_bytes()
    return _Source(hashlib.sha256(text).digest(), tuple(_imports(path, text, packages)))


def _imports(path: Path, text: bytes, packages: Packages) -> Iterator[Path]:
    """The files that the imports at the top of a file name."""
    folders = dict(packages)
    for match in IMPORT.finditer(text):
        words = (match["module"] or match["whole"] or b"").decode().split(".")
        if match["dots"]:
            folder, parts = path.parents[len(match["dots"]) - 1], [word for word in words if word]
        elif words[0] in folders:
            folder, parts = folders[words[0]], words[1:]
        else:
            continue
        names = re.findall(r"\w+", (match["names"] or b"").decode())
        yield from _files(folder.joinpath(*parts), names)


def _files(place: Path, names: list[str]) -> Iterator[Path]:
    """The file of a module, or of a package and those of its modules in ``names``."""
    if (module := place.with_name(f"{place.name}.py")).is_file():
        yield module
    elif (package := place / "__init__.py").is_file():
        yield package
        for name in names:
            yield from _files(place / name, [])
