"""Which of a folder's scenes and models are shown."""

from __future__ import annotations

import pytest

pytest.importorskip("viser", reason="the viewer needs viser (extra view)")

from splatseed.commands import view


def test_a_folder_that_holds_many_says_which_are_shown(room, tmp_path, monkeypatch, capsys):
    for name in "abc":
        (tmp_path / name).symlink_to(room)
    assert [path.name for path in view._within(tmp_path)] == ["a", "b", "c"]
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(view, "MOST_OPENED", 2)
    assert [path.name for path in view._within(tmp_path)] == ["a", "b"]
    said = capsys.readouterr()
    assert "holds 3; shown are the first 2 by name" in " ".join((said.out + said.err).split())
