"""The notebook runs from its first cell to its last, and ends with a picture of the model."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gsplat", reason="training needs PyTorch and gsplat's strategies")

from splatseed.io import load_scene

from ..command_line import exit_code

NOTEBOOK = json.loads((Path(__file__).parents[2] / "examples/colab.ipynb").read_text("utf-8"))
SMALL = {"VIEWS": 12, "WIDTH": 96, "HEIGHT": 72, "MAX_STEPS": 20}
"""In place of what the first cell sets."""


def test_it_is_a_notebook_without_results():
    """As nbformat 4.5 describes notebooks."""
    assert (NOTEBOOK["nbformat"], NOTEBOOK["nbformat_minor"]) == (4, 5)
    assert len({cell["id"] for cell in NOTEBOOK["cells"]}) == len(NOTEBOOK["cells"])
    for cell in NOTEBOOK["cells"]:
        code = {"execution_count", "outputs"} if cell["cell_type"] == "code" else set()
        assert cell.keys() == {"cell_type", "id", "metadata", "source", *code}
        assert not cell.get("outputs")


def _run_here(words, **options):
    """As ``subprocess.run`` does ``python -m splatseed ...``, without another import of PyTorch."""
    assert words[:3] == [sys.executable, "-m", "splatseed"]
    assert options == {"check": True, "capture_output": True, "text": True}
    with redirect_stdout(StringIO()) as out:
        code = exit_code(*words[3:])
    assert code == 0
    return subprocess.CompletedProcess(words, code, out.getvalue(), "")


@pytest.mark.usefixtures("compare_once", "rooms_are_small")
def test_its_cells_run_in_order(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(subprocess, "run", _run_here)
    first, *others = (
        "".join(cell["source"]) for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"
    )
    names = {}
    exec(first, names)  # noqa: S102  (our own notebook)
    assert names.keys() >= SMALL.keys()
    names |= SMALL
    for source in others:
        exec(source, names)  # noqa: S102  (our own notebook)
    assert f"{names['run'].metrics['psnr']:.2f} dB" in capsys.readouterr().out
    page = (tmp_path / names["OUT"] / "model.html").read_text("utf-8")
    assert "<html" in page[:200].lower()

    assert others[-1].splitlines()[-1] == "picture"  # which a notebook shows
    photograph, render = np.hsplit(np.asarray(names["picture"]).astype(float), 2)
    room = load_scene(tmp_path / names["OUT"] / "room")
    assert np.array_equal(photograph, room.images[0].read())
    # Of the right view: closer to its photograph than the photograph's mean colour, or another one.
    mean = photograph.mean(axis=(0, 1))
    for other in (mean, room.images[len(room.images) // 2].read()):
        assert np.abs(render - photograph).mean() < np.abs(other - photograph).mean()
