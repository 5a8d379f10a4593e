"""What a killed process left is removed by the next for the same output; what is written to is
not."""

from __future__ import annotations

import logging
import os
import time

import pytest

pytest.importorskip("fcntl")

from splatseed.io.output.staging import atomic_file, output_folder


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
    assert caplog.messages == [f"Removed {leftover}, left by a run that was killed."]
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


def test_a_leftover_file_is_removed_and_told_of(tmp_path, caplog):
    leftover = tmp_path / ".curve.csv.partial-0123abcd.csv"
    leftover.touch()
    _age(leftover)
    mine = [tmp_path / ".curve.csv.partial-mine.csv", tmp_path / ".other.csv.partial-0123abcd.csv"]
    for path in mine:
        path.touch()
        _age(path)
    with caplog.at_level(logging.WARNING), atomic_file(tmp_path / "curve.csv") as partial:
        partial.write_text("1")
    assert caplog.messages == [f"Removed {leftover}, left by a run that was killed."]
    assert sorted(tmp_path.iterdir()) == sorted([tmp_path / "curve.csv", *mine])


def test_a_file_that_is_being_written_is_not_removed(tmp_path):
    with atomic_file(tmp_path / "a.txt") as first:
        first.write_text("first")
        _age(first)
        with atomic_file(tmp_path / "a.txt") as second:
            second.write_text("second")
        assert first.exists()
    assert (tmp_path / "a.txt").read_text() == "first"


def test_a_run_that_was_killed_just_before_is_cleared_up_at_the_end(leftover, tmp_path, caplog):
    os.utime(leftover)  # so lately that it might be another's who has not locked it yet
    with caplog.at_level(logging.WARNING), output_folder(tmp_path / "out", kind="test"):
        assert leftover.exists()
        _age(leftover)
    assert caplog.messages == [f"Removed {leftover}, left by a run that was killed."]
