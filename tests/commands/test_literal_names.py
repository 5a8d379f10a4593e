"""Commands print the names of files literally, also in errors, and commands that can be pasted."""

from __future__ import annotations

import shutil

import pytest

NAME = "room\x1b[31m:fire:[red]\nx"


@pytest.mark.parametrize("words", [["info"], ["upsample", "--method", "linear"]])
def test_a_name_that_would_act(words, room, tmp_path, splatseed):
    scene = shutil.copytree(room, tmp_path / NAME)
    output = [] if words == ["info"] else ["-o", tmp_path / f"out{NAME}"]
    run = splatseed(words[0], scene, *words[1:], *output)
    assert run.code == 0, run
    assert "\x1b" not in run.out
    assert r"$'" in run.out
    assert r"room\x1b[31m:fire:[red]\nx" in run.out


def test_an_error_with_such_a_name(tmp_path, splatseed):
    run = splatseed("info", tmp_path / NAME)
    assert run.code == 2
    assert run.err.count("\n") == 1
    assert r"room\x1b[31m:fire:[red] x" in run.err
