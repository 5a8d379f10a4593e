"""``--overwrite`` of a verb replaces what that verb wrote, and nothing else."""

from __future__ import annotations

import json

import pytest

from splatseed.bench.running.folder import make_bench_folder
from splatseed.io.output.staging import MANIFEST
from splatseed.train.record.folder import RunFolder


def _run_folder(path):
    RunFolder(path).begin({"splatseed": "0"})
    (path / "point_cloud.ply").touch()


def _bench(path):
    path.mkdir()
    make_bench_folder(path)
    (path / "ledger.sqlite").touch()


def _notes(path):
    path.mkdir()
    (path / MANIFEST).write_text("{}")
    (path / "thesis.tex").write_text("years")


@pytest.mark.parametrize("make", [_run_folder, _bench, _notes])
@pytest.mark.parametrize("verb", ["upsample", "depth", "sfm", "demo", "train"])
def test_another_kinds_folder_is_refused(make, verb, room, tmp_path, splatseed):
    if (make, verb) == (_run_folder, "train"):
        pytest.skip("its own kind")
    out = tmp_path / "out"
    make(out)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    source = {"sfm": [room / "images"], "demo": [], "depth": [room, "--stereo"]}.get(verb, [room])
    run = splatseed(verb, *source, "-o", out, "--overwrite")
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
