"""What a scene names and is no file: pipes, devices, endless links, archives that burst."""

from __future__ import annotations

import dataclasses
import os
import shutil
import socket

import numpy as np
import pytest

from splatseed.bench.plan_file import read_plan
from splatseed.commands.train import parse
from splatseed.errors import OutputError, SceneFormatError, SceneNotFoundError
from splatseed.io import colmap, files, load_originals, load_scene, write_scene
from splatseed.io.depth_files import read_stored
from splatseed.io.files import open_file, read_file
from splatseed.io.photograph import photograph_bytes
from splatseed.io.staging import read_manifest
from splatseed.seeding.advice import untrainable

from ..findings import texts
from .checks import little_memory


@pytest.fixture
def odd(tmp_path):
    """Things in a folder that are no files."""
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(str(tmp_path / "socket"))
    (tmp_path / "link").symlink_to("/dev/zero")
    (tmp_path / "folder").mkdir()
    return tmp_path


@pytest.mark.parametrize(
    ("name", "says"),
    [("pipe", "a pipe"), ("socket", "a socket"), ("link", "a device"), ("folder", "a folder")],
)
def test_only_regular_files_are_opened(odd, name, says):
    with pytest.raises(OSError, match=says):
        open_file(odd / name)
    with pytest.raises(SceneFormatError, match=f"{name} to be a readable file; found {says}"):
        photograph_bytes(odd / name)


@pytest.mark.parametrize(("name", "is_"), [("pipe", "a pipe"), ("link", "a device")])
def test_what_is_no_file_is_not_called_missing(odd, name, is_, scene_dir, model):
    with pytest.raises(SceneNotFoundError, match=f"a scene at .*; found {is_}, not a file"):
        load_scene(odd / name)
    _rename(scene_dir, model, str(odd / name))
    scene = load_scene(scene_dir)
    assert f"{odd / name} is {is_}, not a file." in " ".join(texts(scene))
    shutil.rmtree(scene_dir / "images/left")
    assert f"{odd / name} is {is_}, not a file." in untrainable(scene).text


@pytest.mark.parametrize("kind", ["pipe", "link"])
def test_notes_beside_a_scene_are_not_read_without_end(kind, odd, scene_dir):
    (scene_dir / "splatseed.json").symlink_to(odd / kind)
    assert load_originals(scene_dir).points.num_original == len(load_scene(scene_dir).points)
    assert read_manifest(scene_dir) == {}
    for read in (read_plan, lambda path: parse(["--config", str(path)])):
        with pytest.raises(SceneFormatError, match=r"a pipe|a device"):
            read(odd / kind)


def test_a_file_larger_than_the_memory_is_not_read(tmp_path, monkeypatch):
    (tmp_path / "file").write_bytes(bytes(2 << 20))
    assert read_file(tmp_path / "file") == bytes(2 << 20)
    monkeypatch.setattr(files, "free_memory", lambda: (2 << 20) - 1)
    with pytest.raises(SceneFormatError, match=r"more than the .* of free memory"):
        photograph_bytes(tmp_path / "file")


def _rename(scene_dir, model, name):
    images = [dataclasses.replace(model.images[0], name=name), *model.images[1:]]
    colmap.write_images(scene_dir / "sparse/0/images.bin", images)


@pytest.mark.parametrize("name", ["../../x.jpg", "/dev/zero", "../images/left/image000.jpg"])
def test_a_name_that_leads_out_of_the_scene_is_told(scene_dir, model, name):
    _rename(scene_dir, model, name)
    told = [each for each in texts(load_scene(scene_dir)) if "outside of" in each]
    assert [name in each for each in told] == ([] if "left" in name else [True])


@pytest.mark.parametrize("target", ["/dev/zero", "../images"])
def test_copies_are_of_files_and_end(scene_dir, tmp_path, target):
    (scene_dir / "images/odd").symlink_to(target)
    with pytest.raises(OutputError, match=r"a device|leads back into itself"):
        write_scene(load_scene(scene_dir), tmp_path / "out", copy_images=True)
    assert not (tmp_path / "out").exists()


def test_an_archive_that_would_burst_is_refused_by_its_header(tmp_path):
    np.savez_compressed(tmp_path / "bomb.npz", depth=np.zeros((5000, 5000), np.float32))
    assert (tmp_path / "bomb.npz").stat().st_size < 200_000
    with little_memory(), pytest.raises(SceneFormatError, match=r"100,000,"):
        read_stored(tmp_path / "bomb.npz")
    constant, unread = np.zeros((48, 64), np.float32), np.zeros(1 << 22)
    np.savez_compressed(tmp_path / "more.npz", depth=constant, normals=unread)
    with little_memory(1 << 20):
        assert read_stored(tmp_path / "more.npz").shape == (48, 64)
