"""The Python in docs/training.md runs as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="training and scoring need PyTorch")

from splatseed.io import load_scene
from splatseed.synthetic import make_capture, write_capture
from splatseed.train.gaussians import initial_gaussians
from splatseed.train.ply import write_gaussians

TEXT = (Path(__file__).parents[1] / "docs" / "training.md").read_text("utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def test_the_examples_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_capture(make_capture(0, num_views=9, width=64, height=48), tmp_path / "SCENE")
    (tmp_path / "RUN").mkdir()
    gaussians = initial_gaussians(load_scene("SCENE").points)
    write_gaussians(tmp_path / "RUN/point_cloud.ply", gaussians)
    assert len(BLOCKS) == 2
    for block in BLOCKS:
        exec(block, {})  # noqa: S102  (our own documentation)
    said = capsys.readouterr().out
    assert str(len(gaussians)) in said
    assert "torch.Size([1, 240, 320, 3]) torch.Size([200, 3]) torch.Size([1, 200, 2])" in said
