"""The notebook runs from its first cell to its last, and ends with a picture of the model."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gsplat", reason="training needs PyTorch and gsplat's strategies")

from splatseed.io import load_scene

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


@pytest.mark.slow
def test_its_cells_run_in_order(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
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
