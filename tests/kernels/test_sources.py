"""Machine code from the cache is of the sources as they are, in every file that a kernel
reaches."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest

import splatseed
from splatseed.kernels.sources import reached_files, source_digest

SOURCE = Path(splatseed.__file__).parent

FILES = {
    "__init__": "",
    "kernels": """
from splatseed.kernels.jit import inline

from tiny.middle import (
    halved,
    shifted,
)

@inline
def twice_shifted(x):
    return shifted(2.0 * x) + halved(0.0)
""",
    "middle": """
from splatseed.kernels.jit import inline
from . import numbers
from .numbers import SHIFT

@inline
def shifted(x):
    return x + SHIFT

@inline
def halved(x):
    return numbers.HALF * x
""",
    "numbers": "SHIFT, HALF = 1.0, 0.5\n",
    "aside": "UNUSED = 1.0\n",
}
CALL = """
from tiny.kernels import twice_shifted
value = twice_shifted(3.0)
print(value, len(twice_shifted.stats.cache_hits))
"""


@pytest.fixture
def tiny(tmp_path):
    """A package with a kernel that calls functions of a second file, which use constants of a
    third."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    for name, text in FILES.items():
        (folder / f"{name}.py").write_text(text)
    return folder


def called(tiny):
    """What the kernel returns in a new process, and how often it came from the cache."""
    run = subprocess.run(
        [sys.executable, "-c", CALL], capture_output=True, text=True, check=True, cwd=tiny.parent,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tiny.parent / "cache")},
    )  # fmt: skip
    value, hits = run.stdout.split()
    return float(value), int(hits)


def test_a_kernel_is_compiled_again_when_a_file_that_it_reaches_changes(tiny):
    assert called(tiny) == (7.0, 0)
    for path in tiny.glob("*.py"):
        os.utime(path, (0, 0))  # as a new checkout of the same sources
    (tiny / "aside.py").write_text("UNUSED = 2.0\n")
    assert called(tiny) == (7.0, 1)
    (tiny / "numbers.py").write_text("SHIFT, HALF = 2.0, 0.5\n")
    assert called(tiny) == (8.0, 0)


def test_a_cache_that_names_what_is_gone_is_passed_over(tiny):
    assert called(tiny) == (7.0, 0)
    for index in (tiny.parent / "cache").rglob("*.nbi"):
        with index.open("rb") as file:
            version = pickle.load(file)  # noqa: S301  (our own)
        # What Numba wrote before kernels were keyed on their sources, of a type since moved.
        stale = pickle.dumps(version.partition(" ")[0]) + b"cgone.module\nVector\n."
        index.write_bytes(stale)
    assert called(tiny) == (7.0, 0)


def test_a_file_reaches_what_it_imports_directly_and_by_way_of_others(tiny):
    reached = reached_files(tiny / "kernels.py", "tiny.kernels")
    ours = {path.stem for path in reached if path.parent == tiny}
    assert ours == {"kernels", "middle", "__init__", "numbers"}
    assert reached - set(tiny.iterdir()) == {
        SOURCE / f"kernels/{name}.py" for name in ("jit", "sharing", "sources", "compilation")
    }


def test_kernels_reach_the_files_whose_functions_they_call():
    reached = reached_files(SOURCE / "render" / "harmonics.py", "splatseed.render.harmonics")
    names = {path.relative_to(SOURCE).as_posix() for path in reached}
    assert {"kernels/simd.py", "kernels/shuffles.py", "kernels/jit.py"} <= names
    assert "cli.py" not in names


def test_the_digest_is_of_contents_alone(tiny, tmp_path):
    before = source_digest(tiny / "kernels.py", "tiny.kernels")
    moved = tiny.rename(tmp_path / "elsewhere").rename(tmp_path / "tiny")
    assert source_digest(moved / "kernels.py", "tiny.kernels") == before
    (moved / "middle.py").write_text(FILES["middle"] + "# changed\n")
    assert source_digest(moved / "kernels.py", "tiny.kernels") != before


def test_a_script_reaches_splatseed_only(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("import numpy\nimport splatseed.kernels.simd as simd\nfrom . import gone\n")
    names = {path.name for path in reached_files(script, "__main__")}
    assert names == {"script.py", "simd.py", "jit.py", "sharing.py", "sources.py", "compilation.py"}
