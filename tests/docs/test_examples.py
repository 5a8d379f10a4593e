"""Every example runs, says something, and is short."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest
from PIL import Image as PillowImage

from splatseed.io import load_scene
from splatseed.methods import METHODS

FOLDER = Path(__file__).parents[2] / "examples"
EXAMPLES = sorted(FOLDER.glob("*.py"))


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs an example in an empty folder and returns what it printed."""

    def go(name, *words):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr("sys.argv", [name, *map(str, words)])
        runpy.run_path(str(FOLDER / name), run_name="__main__")
        out, err = capsys.readouterr()
        assert not err
        return out

    return go


def test_they_are_numbered_short_and_tested_here():
    numbers = [f"{i:02d}_" for i in range(1, len(EXAMPLES) + 1)]
    assert [path.name[:3] for path in EXAMPLES] == numbers
    tests = Path(__file__).read_text(encoding="utf-8")
    for path in EXAMPLES:
        text = path.read_text(encoding="utf-8")
        assert text.count("\n") <= 65
        assert f"python examples/{path.name}" in text
        assert f'"{path.name}"' in tests


@pytest.mark.usefixtures("compare_once", "rooms_are_small")
def test_upsample_a_scene(run, tmp_path):
    out = run("01_upsample_a_scene.py", "mine")
    before, after = (load_scene(tmp_path / name) for name in ("mine", "example_room_auto"))
    assert len(after.points) > 2 * len(before.points)
    assert f"{len(after.points):,}" in out


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
    page = (FOLDER.parent / "docs/methods.md").read_text("utf-8")
    (block,) = re.findall(
        r"```python\n(.*?)```", page.partition("## Your own method")[2], re.DOTALL
    )
    assert block in (FOLDER / "04_your_own_method.py").read_text("utf-8")
    assert run("04_your_own_method.py") == "500 points -> 2000, 500 of them the originals\n"


def test_render_on_a_cpu(run, tmp_path):
    out = run("05_render_on_a_cpu.py", 20)
    first, *_, last = re.findall(r"([\d.]+) dB", out)
    assert float(last) > float(first) + 1
    with PillowImage.open(tmp_path / "fitted.png") as picture:
        assert picture.size == (320, 120)


@pytest.mark.usefixtures("rooms_are_small")
def test_train_and_score(run, tmp_path):
    out = run("06_train_and_score.py", "example_room", 4)
    counts = [int(n.replace(",", "")) for n in re.findall(r"([\d,]+) Gaussians", out)]
    assert counts[1] == 4 * counts[0]
    assert (tmp_path / "runs" / "mls_4x" / "point_cloud.ply").is_file()
