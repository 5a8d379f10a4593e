"""``splatseed depth`` from its words to its folder of maps."""

from __future__ import annotations

import json

import pytest

from splatseed.io import find_depths, load_scene

from ...networks import save_network

pytest.importorskip("transformers", reason="needs splatseed[depth]")


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return save_network("depth_anything", tmp_path_factory.mktemp("model") / "tiny")


def test_a_network_of_transformers(room, model, tmp_path, splatseed):
    words = ("depth", room, "--model", model, "-o", tmp_path / "d")
    run = splatseed(*words, "--device", "cpu", "--max-size", 100)
    assert (run.code, run.err) == (0, "")
    for text in ("inverse", "12 of 100 x 75", f"splatseed info {room} --depth {tmp_path / 'd'}"):
        assert text in run.out
    depths = find_depths(load_scene(room), tmp_path / "d")
    assert {depths.read(name).kind for name in depths} == {"inverse"}
    assert len(depths) == 12
    manifest = json.loads((tmp_path / "d" / "splatseed.json").read_text())
    assert manifest["options"]["model"] == str(model)
    assert manifest["kind"] == "inverse"
    assert splatseed(*words).code == 2  # it is there
    assert splatseed(*words, "--overwrite").code == 0


def test_a_blind_network_is_told_of(room, tmp_path, splatseed, monkeypatch):
    from splatseed.depth.monocular import DepthNetwork

    predict = DepthNetwork.__call__
    monkeypatch.setattr(DepthNetwork, "__call__", lambda *a: 0 * predict(*a))
    model = save_network("depth_anything", tmp_path / "blind")
    run = splatseed("depth", room, "--model", model, "--depth-kind", "z", "-o", tmp_path / "d")
    assert run.code == 0
    assert "predicted no depth" in run.out
    assert "and 7 more" in run.out


def test_a_photograph_cut_short_is_found_before_any_work(own_room, model, tmp_path, splatseed):
    path = load_scene(own_room).source.image_dir / load_scene(own_room).images[-1].name
    path.write_bytes(path.read_bytes()[:-200])
    run = splatseed("depth", own_room, "--model", model, "-o", tmp_path / "d")
    assert run.code == 2
    assert path.name in run.err
    assert not (tmp_path / "d").exists()
