"""``--overwrite`` of a verb replaces what that verb wrote, and nothing else."""

from __future__ import annotations

import json

import pytest

from splatseed.bench.runs import begin
from splatseed.io.staging import MANIFEST
from splatseed.train.folder import RunFolder


def _run_folder(path):
    RunFolder(path).begin({"splatseed": "0"})
    (path / "point_cloud.ply").touch()


def _bench(path):
    begin(path, "bench", [], [])
    (path / "plan.toml").touch()


def _notes(path):
    path.mkdir()
    (path / MANIFEST).write_text("{}")
    (path / "thesis.tex").write_text("years")


WORDS = {
    "upsample": ["upsample", "SCENE"],
    "depth": ["depth", "SCENE", "--stereo"],
    "sfm": ["sfm", "SCENE/images"],
    "undistort": ["undistort", "SCENE"],
    "demo": ["demo"],
    "train": ["train", "SCENE"],
}
NEVER_REPLACE = {"bench": ["bench", "--scenes", "SCENE"], "tune": ["tune", "SCENE"]}
"""Without --overwrite, as they go on with what is theirs."""


@pytest.mark.parametrize("make", [_run_folder, _bench, _notes])
@pytest.mark.parametrize("verb", [*WORDS, *NEVER_REPLACE])
def test_another_kinds_folder_is_refused(make, verb, room, tmp_path, splatseed):
    if (make, verb) in {(_run_folder, "train"), (_bench, "bench")}:
        pytest.skip("its own kind")
    out = tmp_path / "out"
    make(out)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    words = [*WORDS[verb], "--overwrite"] if verb in WORDS else NEVER_REPLACE[verb]
    run = splatseed(*(word.replace("SCENE", str(room)) for word in words), "-o", out)
    assert (run.code, run.err.count("\n")) == (2, 1)
    assert str(out) in run.err
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_a_run_lists_what_is_its_own(tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.begin({"splatseed": "0"})
    folder.check(overwrite=True, resume=False, protect=())
    folder.claim([folder.renders / "a.png"])
    folder.renders.mkdir()
    (folder.renders / "a.png").touch()
    folder.check(overwrite=True, resume=False, protect=())
    (folder.renders / "notes.txt").touch()
    with pytest.raises(Exception, match=r"renders/notes\.txt"):
        folder.check(overwrite=True, resume=False, protect=())
    folder.check(overwrite=False, resume=True, protect=())
    assert json.loads((folder.path / MANIFEST).read_text())["command"] == "train"
