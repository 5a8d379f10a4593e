"""Which tests a change asks for: those of the rooms and modules that differ from a revision.

python tests/changed.py [BASE]
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).parents[1]
ALWAYS = "tests/test_package.py"
"""Holds the direction of imports, and every public name to a docstring."""


def tests_of(path: str) -> str | None:
    """The tests of a file, as pytest takes them; None where there are none."""
    parts = PurePosixPath(path).parts
    if parts[0] == "tests" and path.endswith(".py"):
        own = parts[-1].startswith("test_")
        return path if own else str(PurePosixPath(path).parent)
    if parts[:2] != ("src", "splatseed") or len(parts) < 3:
        return None
    room, *below = parts[2:]
    if not below:
        return f"tests/test_{room}"
    nested = f"tests/{room}/{below[0]}"
    return nested if (ROOT / nested).is_dir() else f"tests/{room}"


def changed(base: str) -> Iterator[str]:
    """The files that differ from a revision, also new ones that git does not ignore."""
    for words in (["diff", "--name-only", base], ["ls-files", "--others", "--exclude-standard"]):
        run = subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True)
        yield from run.stdout.splitlines()


def main() -> None:
    """Print the tests of what has changed, whole test folders before their files."""
    wanted = {tests_of(path) for path in changed(*sys.argv[1:2] or ["HEAD"])} | {ALWAYS}
    there = {each for each in wanted if each and each != "tests" and (ROOT / each).exists()}
    within = {e for e in there if any(str(parent) in there for parent in PurePosixPath(e).parents)}
    print(*sorted(there - within))  # noqa: T201  (for the shell)


if __name__ == "__main__":
    main()
