"""``splatseed depth``: from its options to its folder of maps, by a network or by stereo."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import splatseed.depth.stereo
from splatseed.io import find_depths, load_scene
from splatseed.synthetic import write_capture

from ..bent import bend
from ..stereo_maps import true_maps


@pytest.fixture(scope="module")
def capture(room_of):
    """The room of these commands as it was made."""
    return room_of(12, 96, 72).capture


@pytest.fixture
def network(monkeypatch):
    """A network that takes bright for near; ``calls`` are the arguments it was loaded with."""
    monocular = pytest.importorskip("splatseed.depth.monocular", reason="needs PyTorch")
    pytest.importorskip("transformers", reason="needs splatseed[depth]")

    class Network:
        meaning, device, blind = monocular.Meaning("inverse", "made"), "cpu", False

        def __call__(self, image):
            return image.mean(axis=2).astype(np.float32) * (not self.blind)

    network = Network()
    network.calls = []
    load = lambda *args, **options: network.calls.append((*args, options)) or network
    monkeypatch.setattr(monocular, "load_network", load)
    return network


def test_a_network(room, network, tmp_path, splatseed):
    words = ("depth", room, "--model", "tiny", "-o", tmp_path / "d")
    run = splatseed(*words, "--max-size", 80)
    assert (run.code, run.unexpected) == (0, "")
    assert network.calls == [("tiny", {"depth_kind": None})]
    for text in ("inverse", "12 of 80 x 60", f"splatseed info {room} --depth {tmp_path / 'd'}"):
        assert text in run.out
    depths = find_depths(load_scene(room), tmp_path / "d")
    assert {depths.read(name).kind for name in depths} == {"inverse"}
    assert len(depths) == 12
    manifest = json.loads((tmp_path / "d" / "splatseed.json").read_text())
    assert manifest["options"]["model"] == "tiny"
    assert manifest["kind"] == "inverse"
    network.blind = True
    run = splatseed(*words, "--overwrite")
    assert run.code == 0
    assert "view_000.png" in run.err  # named, as its map is flat


@pytest.fixture(scope="module")
def maps(capture):
    """True maps of half the size."""
    return true_maps(capture, 2)


@pytest.fixture
def stereo(maps, monkeypatch):
    """Stereo that returns true ``maps``; ``calls`` are its arguments."""
    known = SimpleNamespace(calls=[], maps=maps)

    def stereo_depths(scene, *, max_size=800, progress=None):
        known.calls.append((len(scene.images), max_size))
        progress("stereo", 1.0)
        names = [image.name for image in scene.images]
        # Any of the images may be a source: no test here depends on which.
        return [
            replace(m, sources=tuple(names[: len(m.sources)]))
            for m in known.maps
            if m.name in names
        ]

    monkeypatch.setattr(splatseed.depth.stereo, "stereo_depths", stereo_depths, raising=False)
    return known


def test_a_plain_folder(room, tmp_path, splatseed, stereo):
    out, words = tmp_path / "maps", ("depth", room, "-o", tmp_path / "maps")
    run = splatseed(*words)
    assert (run.code, run.unexpected) == (0, "")
    assert "48 x 36" in run.out
    assert f"--method depth --depth {out}" in run.out
    depths, known = find_depths(load_scene(room), out), stereo.maps[3]
    assert depths.kind == "z"
    np.testing.assert_allclose(depths.read(known.name).values, known.depth, rtol=1e-6)
    assert json.loads((out / "splatseed.json").read_text())["options"]["colmap"] is False
    assert splatseed(*words, "--overwrite", "--max-size", 500).code == 0
    assert stereo.calls == [(12, 800), (12, 500)]
    run = splatseed(*words, "--overwrite", "--exclude", known.name)
    assert f"left out: {known.name}" in run.err
    assert known.name not in {*find_depths(load_scene(room), out)}
    for verb in ("upsample", "info"):
        assert f"splatseed {verb} {room} --exclude {known.name} " in run.out


@pytest.fixture(scope="module")
def bent(room_of, tmp_path_factory):
    """The room through a lens with distortion, its maps a quarter of it."""
    capture = room_of(12, 96, 72).capture
    return write_capture(bend(capture), tmp_path_factory.mktemp("bent") / "room")


@pytest.mark.usefixtures("pycolmap_here")
def test_a_distorted_capture_becomes_a_cloud_on_its_surfaces(bent, capture, tmp_path, splatseed):
    """From its own stereo to COLMAP's fusion."""
    out = tmp_path / "dense"
    run = splatseed("depth", bent, "--colmap", "-o", out)
    assert (run.code, run.unexpected) == (0, "")
    assert f"splatseed info {out} --depth {out}" in run.out
    assert splatseed("info", out, "--depth", out).code == 0
    name = load_scene(bent).images[0].name
    splatseed("depth", bent, "--colmap", "-o", out, "--overwrite", "--exclude", name)
    assert load_scene(out).absent == (name,)  # it counts for the split into training and test views
    if shutil.which("colmap") is None:
        pytest.skip("colmap is not installed: the command that was printed is not run")
    line = next(line for line in run.out.splitlines() if "stereo_fusion" in line)
    subprocess.run(line.split()[1:], check=True, capture_output=True)
    xyz = load_scene(out / "fused.ply").points.xyz
    assert len(xyz) > 300
    assert np.median(capture.surfaces.distance(xyz.astype(float))) < 0.01  # metres


@pytest.mark.usefixtures("stereo")
def test_a_plain_folder_of_a_distorted_capture_suggests_a_workspace(bent, tmp_path, splatseed):
    run = splatseed("depth", bent, "-o", tmp_path / "maps")
    assert "--colmap" in run.err
    assert "--method depth" not in run.out


def test_missing_photographs_are_found_before_any_work(own_room, tmp_path, splatseed, stereo):
    scene = load_scene(own_room)
    for image in scene.images[len(scene.images) // 2 - 1 :]:
        path = scene.source.image_dir / image.name
        path.unlink()
    run = splatseed("depth", own_room, "--colmap", "-o", tmp_path / "d")
    assert (run.code, scene.images[-2].name in run.err) == (2, False)
    assert not (tmp_path / "d").exists()
    assert not stereo.calls
