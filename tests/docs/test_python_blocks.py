"""The Python in docs and README runs as it stands there."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="training and scoring need PyTorch")

ROOT = Path(__file__).parents[2]
NAMES = ("SEEDED", "SCENE", "garden")
PAGES = {"README.md": 1, "docs/api.md": 5, "docs/training.md": 1}
"""The number of blocks in each."""


@pytest.fixture
def folder(room_of, tmp_path, monkeypatch):
    """The working directory, with a small scene under every name that the pages use."""
    monkeypatch.chdir(tmp_path)
    for name in NAMES:
        shutil.copytree(room_of(12, 64, 48).path, tmp_path / name)
    return tmp_path


@pytest.mark.usefixtures("compare_once")
@pytest.mark.parametrize("page", PAGES)
def test_blocks_run(page, folder, capsys):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)
    assert len(blocks) == PAGES[page]
    for block in blocks:
        # Three steps show that it runs as well as three thousand.
        exec(re.sub(r"max_steps=\d+", "max_steps=3", block), {})  # noqa: S102  (our own documentation)
    out = capsys.readouterr().out
    if page == "docs/api.md":
        assert "torch.Size([1, 240, 320, 3]) torch.Size([200, 3]) torch.Size([1, 200, 2])" in out
