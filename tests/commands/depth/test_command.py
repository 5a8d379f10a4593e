"""``splatseed depth`` from its words to its folder of maps."""

from __future__ import annotations

import json

import numpy as np
import pytest

from splatseed.io import find_depths, load_scene

from ...networks import onnx_sum, save_network

pytest.importorskip("onnxruntime", reason="needs splatseed[depth]")


@pytest.fixture(scope="session")
def onnx_path(tmp_path_factory):
    pytest.importorskip("onnx", reason="the tests write their own files")
    return onnx_sum(tmp_path_factory.mktemp("onnx") / "sum.onnx")


def test_an_onnx_file(room, onnx_path, tmp_path, splatseed):
    run = splatseed("depth", room, "--model", onnx_path, "--depth-kind", "z", "-o", tmp_path / "d")
    assert (run.code, run.err) == (0, "")
    assert "z (as --depth-kind says)" in run.out
    assert "12 of 120 x 90" in run.out
    assert f"splatseed info {room} --depth {tmp_path / 'd'}" in run.out
    scene = load_scene(room)
    depths = find_depths(scene, tmp_path / "d")
    assert len(depths) == 12
    assert {depths.read(name).kind for name in depths} == {"z"}


def test_a_network_of_transformers(room, tmp_path, splatseed):
    pytest.importorskip("transformers", reason="needs splatseed[depth]")
    model = save_network("depth_anything", tmp_path / "tiny")
    words = ("depth", room, "--model", model, "-o", tmp_path / "d", "--batch", 5)
    run = splatseed(*words, "--device", "cpu", "--max-size", 100)
    assert (run.code, run.err) == (0, "")
    assert "inverse (Depth Anything is relative unless its config says metric)" in run.out
    assert "12 of 100 x 75" in run.out
    manifest = json.loads((tmp_path / "d" / "splatseed.json").read_text())
    assert manifest["options"]["model"] == str(model)
    assert manifest["kind"] == "inverse"
    assert splatseed(*words).code == 2  # it is there
    assert splatseed(*words, "--overwrite").code == 0


def test_flags_reach_the_network(room, onnx_path, tmp_path, splatseed):
    words = ("depth", room, "--model", onnx_path, "--depth-kind", "inverse", "--input-size", 90)
    flags = ("--input-multiple", 30, "--mean", 0.5, 0.5, 0.5, "--std", 0.5, 0.5, 0.5)
    assert splatseed(*words, *flags, "-o", tmp_path / "d").code == 0
    depths = find_depths(load_scene(room), tmp_path / "d")
    values = depths.read(next(iter(depths))).values
    assert -7.001 <= values.min() < values.max() <= 7.001  # (x / 255 - 1/2) / (1/2), weights 1 2 4
    plain = splatseed(*words, "--input-multiple", 30, "-o", tmp_path / "plain")
    assert plain.code == 0
    other = find_depths(load_scene(room), tmp_path / "plain")
    assert not np.allclose(other.read(next(iter(other))).values, values)


def test_a_blind_network_is_told_of(room, onnx_path, tmp_path, splatseed):
    flags = ("--mean", 1e9, 1e9, 1e9, "--std", 1e30, 1e30, 1e30)  # all the same in 32 bits
    words = ("depth", room, "--model", onnx_path, "--depth-kind", "inverse", *flags)
    run = splatseed(*words, "-o", tmp_path / "d")
    assert run.code == 0
    assert "predicted no depth" in run.out
    assert "and 7 more" in run.out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--model", "nobody/Depth-Nothing-hf"), "hf download nobody/Depth-Nothing-hf"),
        (("--model", "gone.onnx"), "an ONNX file at gone.onnx"),
        (("--model", "SUM"), "--depth-kind inverse"),
        (("--model", "SUM", "--depth-kind", "z", "--batch", 0), "--batch of 1 or more"),
        (("--model", "SUM", "--depth-kind", "z", "--std", 0, 1, 1), "--std above 0"),
        (("--model", "SUM", "--depth-kind", "up"), "depth-kind"),
        ((), "--model"),
    ],
)
def test_bad_words_end_in_one_line_and_no_folder(words, said, room, onnx_path, tmp_path, splatseed):
    words = [onnx_path if word == "SUM" else word for word in words]
    run = splatseed("depth", room, *words, "-o", tmp_path / "d")
    assert run.code == 2
    assert said in run.err
    assert run.err.count("\n") == 1
    assert not (tmp_path / "d").exists()


def test_a_photograph_cut_short_is_found_before_any_work(own_room, onnx_path, tmp_path, splatseed):
    scene = load_scene(own_room)
    path = scene.source.image_dir / scene.images[-1].name
    path.write_bytes(path.read_bytes()[:-200])
    words = ("--model", onnx_path, "--depth-kind", "z", "-o", tmp_path / "d")
    run = splatseed("depth", own_room, *words)
    assert run.code == 2
    assert path.name in run.err
    assert not (tmp_path / "d").exists()


def test_help_waits_for_no_network(splatseed):
    run = splatseed("depth", "--help")
    assert run.code == 0
    assert "--model" in run.out
