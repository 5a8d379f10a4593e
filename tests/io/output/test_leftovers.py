"""What a killed process left is removed by the next for the same output; what is written to is
not."""

from __future__ import annotations

import logging
import os
import time

import pytest

pytest.importorskip("fcntl")

from splatseed.io.output.staging import output_folder


@pytest.fixture
def leftover(tmp_path):
    path = tmp_path / ".out.partial-0123abcd"
    (path / "deep").mkdir(parents=True)
    (path / "deep/file").touch()
    _age(path)
    return path


def _age(path):
    os.utime(path, (time.time() - 100, time.time() - 100))


def _write(tmp_path, name="out"):
    with output_folder(tmp_path / name, kind="test") as partial:
        (partial / "file").touch()


def test_a_leftover_is_removed_and_told_of(leftover, tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        _write(tmp_path)
    assert not leftover.exists()
    assert caplog.messages == [f"Removed {leftover}, which a run left that was killed."]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("name", ["other", "out.b", "partial"])
def test_another_outputs_leftover_stays(name, leftover, tmp_path):
    _write(tmp_path, name)
    assert leftover.exists()


def test_a_new_one_and_what_only_looks_like_one_stay(leftover, tmp_path):
    os.utime(leftover)
    (tmp_path / ".out.partial-notes").mkdir()
    _age(tmp_path / ".out.partial-notes")
    _write(tmp_path)
    assert leftover.exists()
    assert (tmp_path / ".out.partial-notes").exists()


def test_what_is_being_written_is_not_removed(tmp_path):
    with output_folder(tmp_path / "out", kind="test") as first:
        (first / "file").touch()
        _age(first)
        with pytest.raises(KeyboardInterrupt), output_folder(tmp_path / "out", kind="test"):
            raise KeyboardInterrupt
        assert (first / "file").exists()
    assert (tmp_path / "out/file").exists()
