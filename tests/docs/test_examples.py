"""Every example runs, says something, and is short."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image as PillowImage

from splatseed.io import load_scene
from splatseed.upsample import METHODS

FOLDER = Path(__file__).parents[2] / "examples"
EXAMPLES = sorted(FOLDER.glob("*.py"))


@pytest.fixture
def run(tmp_path):
    """Runs an example in an empty folder and returns what it printed."""

    def go(name, *words):
        command = [sys.executable, str(FOLDER / name), *map(str, words)]
        done = subprocess.run(
            command, cwd=tmp_path, capture_output=True, check=False, text=True, timeout=120
        )
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout

    return go


def test_they_are_numbered_short_and_tested_here():
    assert [path.name[:3] for path in EXAMPLES] == [
        f"{i:02d}_" for i in range(1, len(EXAMPLES) + 1)
    ]
    tests = Path(__file__).read_text(encoding="utf-8")
    for path in EXAMPLES:
        text = path.read_text(encoding="utf-8")
        assert text.count("\n") <= 65
        assert f"python examples/{path.name}" in text
        assert f'"{path.name}"' in tests


def test_upsample_a_scene(run, tmp_path):
    out = run("01_upsample_a_scene.py")
    before, after = (load_scene(tmp_path / name) for name in ("example_room", "example_room_auto"))
    assert len(after.points) > 2 * len(before.points)
    assert f"{len(after.points):,}" in out
    run("01_upsample_a_scene.py", "example_room", "mine")
    assert len(load_scene(tmp_path / "mine").points) > 0


def test_arrays_in_arrays_out(run):
    out = run("02_arrays_in_arrays_out.py")
    off = {line.split()[0]: float(line.split()[-2]) for line in out.splitlines()[:2]}
    assert off["mls"] < off["linear"]  # a curved fit follows a sphere, a chord cuts through it
    assert "found 'neighbours'" in out


NEED_PHOTOGRAPHS = {"depth", "stereo", "cover", "auto", "cloud"}


def test_compare_methods(run):
    header, *rows = run("03_compare_methods.py").splitlines()
    methods = [name for name in METHODS if name not in NEED_PHOTOGRAPHS]
    assert header.split()[3:] == methods
    assert len(rows) >= 5
    for row in rows:
        errors = [float(x) for x in re.findall(r"([\d.]+) /", row)]
        assert len(errors) == len(methods)
        assert max(errors) == errors[methods.index("random")]


def test_your_own_method(run):
    assert run("04_your_own_method.py") == "500 points -> 2000, 500 of them the originals\n"


def test_render_on_a_cpu(run, tmp_path):
    out = run("05_render_on_a_cpu.py", 40)
    first, *_, last = re.findall(r"([\d.]+) dB", out)
    assert float(last) > float(first) + 3
    with PillowImage.open(tmp_path / "fitted.png") as picture:
        assert picture.size == (320, 120)


@pytest.mark.slow
def test_train_and_score(run, tmp_path):
    out = run("06_train_and_score.py", "example_room", 40)
    counts = [int(n.replace(",", "")) for n in re.findall(r"([\d,]+) Gaussians", out)]
    assert counts[1] == 4 * counts[0]
    assert (tmp_path / "runs" / "mls_4x" / "point_cloud.ply").is_file()
