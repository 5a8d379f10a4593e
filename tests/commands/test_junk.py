"""Junk where a file should be, and places that cannot be written to, give one line."""

from __future__ import annotations

import re
import sys
import warnings
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("torch")

import torch

from splatseed.errors import OutputError, SceneFormatError
from splatseed.io.staging import atomic_file, output_folder
from splatseed.splat.metrics import load_lpips
from splatseed.train.settings import TrainSettings
from splatseed.train.state import load_checkpoint, make_strategy

CPU = torch.device("cpu")


def _refused(run, *says):
    assert (run.code, run.err.count("\n")) == (2, 1), run
    assert run.err.startswith("error: expected ")
    assert "Traceback" not in run.err
    for each in says:
        assert each in run.err


def _spoiled(data, rng, how):
    data = bytearray(data)
    if how == "cut":
        return bytes(data[: len(data) // 2])
    for at in rng.integers(0, len(data), 40):
        data[at] ^= int(rng.integers(1, 256))
    return bytes(data)


@pytest.mark.parametrize("how", ["cut", "flipped", "text", "pickle", "zip"])
@pytest.mark.parametrize("what", ["checkpoint", "weights"])
def test_a_damaged_file_of_pytorchs(what, how, rng, tmp_path):
    path = tmp_path / "file"
    torch.save({"format": 2, "params": {"means": torch.zeros(30, 3)}, "step": 3}, path)
    whole = path.read_bytes()
    for _ in range(20 if how == "flipped" else 1):
        text = {"text": b"junk", "pickle": b"\x80\x04cos\nsystem\n(X\x02\x00\x00\x00lstR."}.get(how)
        path.write_bytes(text or _spoiled(whole, rng, how))
        if how == "zip":
            with zipfile.ZipFile(path, "w") as archive:
                archive.writestr("archive/data.pkl", b"(")
        with pytest.raises(SceneFormatError), warnings.catch_warnings(action="error"):
            _load(what, path)


def _load(what, path):
    if what == "weights":
        return load_lpips(path)
    settings = TrainSettings(strategy="none", backend="cpu")
    return load_checkpoint(path, make_strategy(settings, CPU), settings.schedule, CPU)


def test_a_link_to_itself(room, tmp_path, splatseed):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for verb in (["upsample", room], ["depth", room, "--stereo"], ["train", room]):
        _refused(splatseed(*verb, "-o", tmp_path / "loop"), "leads back to itself")
    _refused(splatseed("info", tmp_path / "loop"), "loop")
    with pytest.raises(OutputError, match="loop"), atomic_file(tmp_path / "loop"):
        pass


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_output(room, splatseed, monkeypatch):
    with pytest.raises(OutputError, match="a device"), atomic_file(Path("/dev/full")):
        pass
    with pytest.raises(OutputError, match="a file"), output_folder(Path("/dev/full"), kind="x"):
        pass
    assert Path("/dev/full").is_char_device()
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        run = splatseed("info", room)
        full.close = lambda: None  # what is left in its buffer cannot be written
    _refused(run, "No space left on device")


PYTHON = re.compile(r"<\w+[.\w]* |0x[0-9a-f]{5}|\bb['\"]|\\x|\b\w+Error\b")
"""What only Python's programmers understand."""
JUNK = {"bytes": bytes([137, 3, 0, 255, 13]) * 40, "text": b"some words\n" * 9, "empty": b""}


@pytest.mark.parametrize("junk", JUNK)
@pytest.mark.parametrize(
    "words",
    [
        "info junk.ply",
        "info room",
        "upsample room -o out",
        "train room -o out --max-steps 1",
        "sfm room/images -o out",
        "depth room --stereo -o out",
        "info room --depth maps",
        "info transforms",
        "export junk.ply -o out.splat",
        "upsample room -o out --cloud junk.ply",
    ],
)
def test_junk_is_told_without_python(words, junk, own_room, tmp_path, monkeypatch, splatseed):
    if words.startswith("sfm"):
        pytest.importorskip("pycolmap", reason="sfm needs pycolmap")
    monkeypatch.chdir(tmp_path)
    own_room.rename("room")
    (tmp_path / "maps").mkdir()
    for image in sorted((tmp_path / "room" / "images").iterdir()):
        (tmp_path / "maps" / f"{image.stem}.npy").write_bytes(JUNK[junk])
        image.write_bytes(JUNK[junk])
    (tmp_path / "transforms").mkdir()
    (tmp_path / "junk.ply").write_bytes(JUNK[junk])
    (tmp_path / "transforms" / "transforms.json").write_bytes(JUNK[junk])
    run = splatseed(*words.split())
    assert not PYTHON.search(run.out + run.err), run
    if words != "info room":  # which lists photographs that cannot be read
        _refused(run)
        assert not (tmp_path / "out").exists()
