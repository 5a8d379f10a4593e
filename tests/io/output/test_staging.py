"""Output folders and files appear whole or not at all, and nothing of the user's is overwritten."""

from __future__ import annotations

import errno
import os
import re
import sys
import tempfile
from pathlib import Path

import pytest

from splatseed.errors import OutputError
from splatseed.io.output.staging import (
    MANIFEST,
    atomic_file,
    check_output,
    check_parents,
    output_folder,
)


def listing(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def write_output(path: Path, text: str, **options) -> None:
    with output_folder(path, kind="test", **options) as partial:
        (partial / "text").write_text(text)


def test_folder_is_hidden_until_the_end_and_its_parent_is_made(tmp_path):
    target = tmp_path / "a" / "out"
    with output_folder(target, kind="test") as partial:
        assert partial.parent == target.parent
        assert partial.name.startswith(".out.partial-")
        assert not target.exists()
        (partial / "file").write_text("x")
    assert listing(tmp_path) == ["a", "a/out", "a/out/file", f"a/out/{MANIFEST}"]


def test_a_mistyped_path_makes_no_folders(tmp_path):
    missing = rf"found no {re.escape(str(tmp_path / 'nope'))}\. Check the path"
    deep = tmp_path / "nope" / "x" / "y" / "out"
    with pytest.raises(OutputError, match=missing):
        check_output(deep, kind="test")
    with pytest.raises(OutputError, match=missing):
        check_parents(deep)
    assert listing(tmp_path) == []


def _refused(**_):
    raise PermissionError


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs /proc")
def test_a_system_without_folders_of_ours_is_refused_beforehand():
    with pytest.raises(OutputError, match="found /proc, which is write-protected"):
        check_output(Path("/proc/out"), kind="test")


def test_a_place_in_which_nothing_can_be_made_is_refused_beforehand(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="file, which is not a folder"):
        check_output(tmp_path / "file" / "out", kind="test")
    check_output(tmp_path / "out", kind="test")
    assert listing(tmp_path) == ["file"]
    monkeypatch.setattr(tempfile, "mkdtemp", _refused)  # root may write nearly everywhere
    with pytest.raises(OutputError, match="write-protected"):
        check_output(tmp_path / "out", kind="test")
    (tmp_path / "there").mkdir()
    check_output(tmp_path / "there", kind="test")


@pytest.mark.parametrize(
    "failure", [RuntimeError("x"), KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left")]
)
def test_nothing_is_left_behind_by_a_failure(tmp_path, failure):
    expected = OutputError if isinstance(failure, OSError) else type(failure)

    def fail():
        with output_folder(tmp_path / "new" / "out", kind="test") as partial:
            (partial / "file").write_text("x")
            raise failure

    with pytest.raises(expected):
        fail()
    assert listing(tmp_path) == []


def test_full_disk_is_told_with_what_to_do(tmp_path):
    with (
        pytest.raises(OutputError, match=r"No space left.*Free some space"),
        output_folder(tmp_path / "out", kind="test"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_failure_keeps_the_earlier_output(tmp_path):
    target = tmp_path / "out"
    write_output(target, "first")
    with pytest.raises(KeyboardInterrupt), output_folder(target, kind="test", overwrite=True):
        raise KeyboardInterrupt
    assert (target / "text").read_text() == "first"
    assert listing(tmp_path) == ["out", f"out/{MANIFEST}", "out/text"]


def test_failing_rename_brings_the_earlier_output_back(tmp_path, monkeypatch):
    target = tmp_path / "out"
    write_output(target, "first")
    rename = Path.rename

    def rename_unless_partial(self: Path, other: Path) -> Path:
        if ".partial-" in self.name:
            raise OSError(errno.EIO, "Input/output error")
        return rename(self, other)

    monkeypatch.setattr(Path, "rename", rename_unless_partial)
    with pytest.raises(OutputError, match="Input/output error"):
        write_output(target, "second", overwrite=True)
    assert (target / "text").read_text() == "first"
    assert listing(tmp_path) == ["out", f"out/{MANIFEST}", "out/text"]


def test_only_an_output_of_splatseed_is_replaced_and_only_when_asked(tmp_path):
    target = tmp_path / "out"
    target.mkdir()
    write_output(target, "first")  # an empty folder is free
    with pytest.raises(OutputError, match="--overwrite"):
        write_output(target, "second")
    write_output(target, "second", overwrite=True)
    assert (target / "text").read_text() == "second"
    foreign = tmp_path / "photos"
    foreign.mkdir()
    (foreign / "precious.jpg").touch()
    with pytest.raises(OutputError, match="did not write"):
        write_output(foreign, "third", overwrite=True)
    assert listing(foreign) == ["precious.jpg"]


def test_output_may_not_touch_what_is_read(tmp_path, monkeypatch):
    scene = tmp_path / "data" / "scene"
    scene.mkdir(parents=True)
    link = tmp_path / "link"
    link.symlink_to(scene, target_is_directory=True)
    for target in (scene, scene / "out", scene.parent, link):
        with pytest.raises(OutputError, match="apart from the input"):
            write_output(target, "x", protect=(scene,))
    write_output(tmp_path / "data" / "out", "x", protect=(scene,))
    monkeypatch.chdir(scene)
    with pytest.raises(OutputError, match="working directory"):
        write_output(Path(), "x")


def test_file_in_the_way_is_an_error(tmp_path):
    (tmp_path / "out").touch()
    with pytest.raises(OutputError, match="a file"):
        write_output(tmp_path / "out", "x", overwrite=True)
    with pytest.raises(OutputError):
        write_output(tmp_path / "out" / "deeper", "x")


@pytest.mark.skipif(
    sys.platform == "win32" or os.geteuid() == 0, reason="needs a user whom permissions bind"
)
def test_no_permission_is_told(tmp_path):
    tmp_path.chmod(0o555)
    with pytest.raises(OutputError, match="may write to"):
        write_output(tmp_path / "out", "x")


def test_no_permission_is_told_simulated(tmp_path, monkeypatch):
    def refuse(*_args, **_options):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(OutputError, match=r"Permission denied.*may write to"):
        write_output(tmp_path / "out", "x")


def test_atomic_file_replaces_whole_and_keeps_its_suffix(tmp_path):
    target = tmp_path / "deep" / "picture.png"
    with atomic_file(target) as partial:
        assert partial.suffix == ".png"
        assert ".partial-" in partial.name
        partial.write_text("first")
        assert not target.exists()
    with pytest.raises(UnicodeEncodeError), atomic_file(target) as partial:
        partial.write_text("half, then \ud800", encoding="utf-8")
    assert target.read_text() == "first"
    assert listing(target.parent) == ["picture.png"]
    with atomic_file(target) as partial:
        partial.write_text("second")
    assert target.read_text() == "second"


def test_atomic_file_refuses_folders(tmp_path):
    with pytest.raises(OutputError), atomic_file(tmp_path):
        pass
