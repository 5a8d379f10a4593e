"""The Python in docs/training.md runs as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="training and scoring need PyTorch")

from splatseed.synthetic import make_capture, write_capture

TEXT = (Path(__file__).parents[2] / "docs" / "training.md").read_text("utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def test_the_examples_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    capture = make_capture(0, num_views=9, width=64, height=48)
    for name in ("SEEDED", "SCENE"):
        write_capture(capture, tmp_path / name)
    assert len(BLOCKS) == 3
    for block in BLOCKS:
        # Our own documentation; three steps show that it runs as well as three thousand.
        exec(block.replace("max_steps=3000", "max_steps=3"), {})  # noqa: S102  (runs the documentation's code)
    said = capsys.readouterr().out
    assert str(len(capture.scene.points)) in said
    assert "torch.Size([1, 240, 320, 3]) torch.Size([200, 3]) torch.Size([1, 200, 2])" in said
