"""Outputs appear whole or not at all, and nothing of the user's is overwritten or removed."""

from __future__ import annotations

import errno
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path
from unittest.mock import Mock

import pytest

from splatseed.errors import OutputError
from splatseed.io.staging import (
    MANIFEST,
    add_files,
    atomic_file,
    check_output,
    check_parents,
    output_folder,
    read_manifest,
)


def listing(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def hidden(folder):
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))


def write_output(path, text="x", failure=None, **options):
    with output_folder(path, kind="test", **options) as partial:
        (partial / "text").write_text(text)
        if failure is not None:
            raise failure


@pytest.fixture
def output(tmp_path):
    path = tmp_path / "out"
    with output_folder(path, kind="test") as partial:
        for name in ("images/left/a.png", "sparse/0/points3D.bin", "text"):
            (partial / name).parent.mkdir(parents=True, exist_ok=True)
            (partial / name).write_text("first")
    return path


def test_outputs_are_hidden_until_the_end_and_their_parents_are_made(tmp_path):
    target = tmp_path / "a" / "b" / "out"
    with output_folder(target, kind="test") as partial:
        assert partial.name.startswith(".out.partial-")
        assert not target.exists()
        (partial / "file").write_text("x")
    assert listing(target) == ["file", MANIFEST]
    assert read_manifest(target) == {"command": "test", "files": ["file", MANIFEST]}
    picture = tmp_path / "deep" / "picture.png"
    with atomic_file(picture) as partial:
        assert (partial.suffix, picture.exists()) == (".png", False)
        partial.write_text("first")
    with pytest.raises(UnicodeEncodeError), atomic_file(picture) as partial:
        partial.write_text("half, then \ud800", encoding="utf-8")
    assert (listing(picture.parent), picture.read_text()) == (["picture.png"], "first")


PERMISSION = PermissionError(errno.EACCES, "Permission denied")


@pytest.mark.parametrize(
    ("failure", "error", "said"),
    [
        (KeyboardInterrupt(), KeyboardInterrupt, None),
        (OSError(errno.ENOSPC, "No space left"), OutputError, "No space left.*Free some space"),
        (PERMISSION, OutputError, "may write to"),
    ],
)
@pytest.mark.parametrize("there", [False, True])
def test_a_failure_leaves_nothing_or_the_earlier_output(tmp_path, failure, error, said, there):
    out = tmp_path / "new/out"
    if there:
        write_output(out, "first")
    before = listing(tmp_path)
    with pytest.raises(error, match=said):
        write_output(out, "second", failure, overwrite=True)
    assert listing(tmp_path) == before
    assert not there or (out / "text").read_text() == "first"


@pytest.mark.parametrize(("method", "text"), [("rename", "first"), ("replace", "second")])
def test_an_interrupt_between_renames_hides_no_output(output, monkeypatch, method, text):
    """The interrupt comes right after a rename has worked, before the next line runs."""
    real = getattr(Path, method)

    def interrupted(self, other):
        real(self, other)
        if (other if method == "replace" else self) == output:
            raise KeyboardInterrupt

    monkeypatch.setattr(Path, method, interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_output(output, "second", overwrite=True)
    assert hidden(output.parent) == []
    assert ((output / MANIFEST).is_file(), (output / "text").read_text()) == (True, text)


def test_a_place_in_which_nothing_can_be_made_is_refused_beforehand(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    for bad in (tmp_path / "nope/x/y/out", tmp_path / "file/out"):
        with pytest.raises(OutputError, match=r"nope|file"):
            check_output(bad, kind="test")
    check_output(tmp_path / "out", kind="test")
    assert listing(tmp_path) == ["file"]

    # Root may write nearly everywhere.
    monkeypatch.setattr(tempfile, "mkdtemp", Mock(side_effect=PERMISSION))
    with pytest.raises(OutputError, match="write-protected"):
        check_parents(tmp_path / "out")
    (tmp_path / "there").mkdir()
    check_output(tmp_path / "there", kind="test")


def test_only_an_earlier_output_is_replaced_and_only_when_asked(tmp_path):
    target = tmp_path / "out"
    target.mkdir()
    write_output(target, "first")  # an empty folder is free
    with pytest.raises(OutputError, match="overwrite=True"):
        write_output(target)
    write_output(target, overwrite=True)
    with pytest.raises(OutputError, match="what splatseed test wrote, not train"):
        check_output(target, kind="train", overwrite=True)
    (tmp_path / "file").touch()
    for path in (tmp_path / "file", tmp_path / "file" / "deeper"):
        with pytest.raises(OutputError):
            write_output(path, overwrite=True)
    for path in (tmp_path, Path("/dev/null")):
        with pytest.raises(OutputError), atomic_file(path):
            pass


def test_output_may_not_touch_what_is_read(tmp_path, monkeypatch):
    scene = tmp_path / "data" / "scene"
    scene.mkdir(parents=True)
    link = tmp_path / "link"
    link.symlink_to(scene, target_is_directory=True)
    for target in (scene, scene / "out", scene.parent, link):
        with pytest.raises(OutputError, match="apart from the input"):
            write_output(target, protect=(scene,))
    write_output(tmp_path / "data" / "out", protect=(scene,))
    monkeypatch.chdir(scene)
    with pytest.raises(OutputError, match="working directory"):
        write_output(Path())


@pytest.mark.parametrize("text", ["{}", '{"command": "test"}', "not JSON", "[]"])
def test_a_folder_without_a_list_is_somebody_elses(output, text):
    (output / MANIFEST).write_text(text)
    before = listing(output)
    with pytest.raises(OutputError, match="did not write"):
        write_output(output, overwrite=True)
    assert listing(output) == before


MADE_AGAIN = (
    *("preview_methods.png", "images_2/left/a.png"),  # nerfstudio's
    "images_2_png/left/a.png",  # gsplat's
    *(".points.partial-0123abcd", ".a.partial-0123abcd.pt"),
)


@pytest.mark.parametrize("name", ["sparse/0/project.ini", "images_8", "sparse/1", *MADE_AGAIN])
def test_files_and_links_of_the_users_are_spared_but_what_can_be_made_again(output, name):
    (output / name).parent.mkdir(parents=True, exist_ok=True)
    (output / name).symlink_to(output / MANIFEST)
    with nullcontext() if name in MADE_AGAIN else pytest.raises(OutputError, match=name):
        write_output(output, overwrite=True)
    assert (output / name).is_symlink() == (name not in MADE_AGAIN)
    assert hidden(output.parent) == []


def test_what_somebody_puts_there_while_we_work_is_kept_aside(output, caplog):
    with output_folder(output, kind="test", overwrite=True):
        (output / "notes.txt").touch()
    (kept,) = hidden(output.parent)
    assert (output.with_name(kept) / "notes.txt").exists()
    assert kept in caplog.text


def test_an_output_in_an_output_has_its_own_list(output):
    for name in ("run", "extra"):
        (output / name).mkdir()
        (output / name / "metrics.json").touch()
    (output / "run" / MANIFEST).write_text('{"command": "train", "files": ["metrics.json"]}')
    with pytest.raises(OutputError, match=r"run/metrics\.json"):
        write_output(output, overwrite=True)
    add_files(output, ["run", "extra"])
    (output / "run/notes.txt").touch()
    with pytest.raises(OutputError, match=r"did not write: run/notes\.txt"):
        write_output(output, overwrite=True)
    (output / "run/notes.txt").unlink()
    write_output(output, overwrite=True)
    assert listing(output) == [MANIFEST, "text"]


# What a kill leaves


@pytest.mark.skipif(sys.platform == "win32", reason="needs locks of folders")
def test_what_a_kill_left_is_removed_and_told_of(tmp_path, caplog):
    gone = [".out.partial-0123abcd", ".curve.csv.partial-0123abcd.csv"]
    kept = [".other.partial-0123abcd", ".out.partial-notes", ".curve.csv.partial-mine.csv"]
    for name in (*gone, *kept):
        (tmp_path / name).touch() if name.endswith(".csv") else (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (time.time() - 100,) * 2)
    (tmp_path / ".out.partial-0000aaaa").mkdir()  # perhaps another process's, not yet locked
    with caplog.at_level(logging.WARNING), atomic_file(tmp_path / "curve.csv"):
        write_output(tmp_path / "out")
    assert hidden(tmp_path) == sorted([*kept, ".out.partial-0000aaaa"])
    assert all(name in caplog.text for name in gone)
    with output_folder(tmp_path / "live", kind="test") as first:
        (first / "file").touch()
        os.utime(first, (time.time() - 100,) * 2)
        write_output(tmp_path / "live")
        assert (first / "file").exists()  # another process still writes it


READ_ONLY = """
import sys
from pathlib import Path
from splatseed.io.staging import output_folder

out, pictures = Path(sys.argv[1]) / "out", Path(sys.argv[1]) / "pictures"
for _ in range(2):
    with output_folder(out, kind="test", overwrite=True) as partial:
        (partial / "deep/er").mkdir(parents=True)
        (partial / "link").symlink_to(pictures, target_is_directory=True)
        (partial / "deep/er").chmod(0o555)
        (partial / "deep").chmod(0o555)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX permissions")
def test_read_only_folders_of_ours_are_removed_and_links_are_not_followed(tmp_path):
    (tmp_path / "pictures").mkdir(mode=0o555)
    run = [sys.executable, "-c", READ_ONLY, str(tmp_path)]
    if os.geteuid() == 0:  # as a user whom permissions bind
        setpriv = shutil.which("setpriv") or pytest.skip("runs as root, without setpriv")
        run = [setpriv, "--bounding-set=-dac_override,-dac_read_search,-fowner", *run]
    ended = subprocess.run(run, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert hidden(tmp_path) == []
    assert (tmp_path / "pictures").stat().st_mode & 0o777 == 0o555
