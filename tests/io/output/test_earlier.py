"""Points of an earlier upsampling are told from the originals, and never grow new ones."""

from __future__ import annotations

import json

import numpy as np
import pytest

from splatseed import load_scene, upsample, write_scene
from splatseed.errors import SceneNotFoundError
from splatseed.io import load_originals
from splatseed.io.output.earlier import saw_all_photographs, was_upsampled
from splatseed.io.output.seeds_npz import SEEDS
from splatseed.pointcloud import GENERATED
from splatseed.progress import silent
from splatseed.synthetic import make_capture
from splatseed.train.seeds import seeded
from splatseed.train.settings import TrainSettings


@pytest.fixture(scope="module")
def scene():
    return make_capture(0, 6, 96, 72).scene


@pytest.mark.parametrize("layout", ["colmap", "transforms"])
def test_an_output_knows_its_originals(scene, tmp_path, layout):
    seeds = upsample(scene, "mls", ratio=4)
    write_scene(scene.replace(points=seeds), tmp_path / "out", format=layout)
    again = load_scene(tmp_path / "out")
    n = len(scene.points)
    assert np.array_equal(again.points.source, seeds.source)
    assert not any("upsampling again" in warning for warning in again.warnings)
    assert again.tracks is None or len(again.tracks) == n
    more = upsample(again, "linear", ratio=2)
    assert len(more) == 2 * n
    write_scene(again.replace(points=more), tmp_path / "more")
    assert len(load_scene(tmp_path / "more").points.originals) == n


def test_an_output_of_an_earlier_version_knows_its_originals(scene, tmp_path):
    write_scene(scene.replace(points=upsample(scene, "linear", ratio=4)), tmp_path / "out")
    (tmp_path / "out" / SEEDS).unlink()
    again, n = load_scene(tmp_path / "out"), len(scene.points)
    assert np.array_equal(again.points.source == GENERATED, np.arange(4 * n) >= n)
    assert len(again.tracks) == n


@pytest.mark.parametrize("known", [True, False])
def test_a_scene_without_originals_keeps_what_its_points_are(scene, tmp_path, known):
    new = scene.points.replace(source=np.full(len(scene.points), 6, np.uint8))
    report = write_scene(scene.replace(points=new, tracks=None), tmp_path / "out")
    if not known:
        (tmp_path / "out" / SEEDS).unlink()
    again = load_scene(tmp_path / "out")
    assert set(again.points.source) == {6 if known else GENERATED}
    assert was_upsampled(again)
    assert len(again.points.references) == len(new)
    if known:
        write_scene(again, tmp_path / "again")
        for name in set(report.files) - {"splatseed.json", "images"}:
            there = (tmp_path / "again" / name).read_bytes()
            assert there == (tmp_path / "out" / name).read_bytes()
    bare = load_originals(tmp_path / "out", require_points=False)
    assert not len(bare.points)
    assert f"the {len(new):,} points that splatseed added before are replaced" in bare.warnings[-1]
    with pytest.raises(SceneNotFoundError, match=f"found none: it made all {len(new):,}"):
        load_originals(tmp_path / "out")


@pytest.mark.parametrize(
    ("told", "all_of_them"),
    [
        ({"command": "upsample", "parameters": {"hold_out": 0}}, True),
        ({"command": "upsample", "parameters": {"hold_out": 8}}, False),
        ({"command": "upsample", "parameters": {"k": 16}}, False),  # not made from photographs
        ({"command": "upsample"}, False),
        ({"command": "tune", "parameters": {"hold_out": 0}}, False),
    ],
)
def test_seeds_that_saw_the_test_views_are_known(scene, tmp_path, told, all_of_them):
    seeds = upsample(scene, "linear", ratio=2)
    write_scene(scene.replace(points=seeds), tmp_path / "out", provenance=told)
    again, notes = load_scene(tmp_path / "out"), []
    assert saw_all_photographs(again) == all_of_them
    seeded(again, TrainSettings(seeding="scene"), "cpu", notes.append, silent)
    assert any("test views included" in note for note in notes) == all_of_them
    assert not saw_all_photographs(scene)


@pytest.mark.parametrize("layout", ["colmap", "transforms"])
def test_an_output_is_written_back_byte_for_byte(scene, tmp_path, layout):
    seeds = upsample(scene, "triangle", ratio=3)
    write_scene(scene.replace(points=seeds), tmp_path / "out", format=layout)
    report = write_scene(load_scene(tmp_path / "out"), tmp_path / "again")
    assert report.layout == layout
    assert (report.num_original, report.num_points) == (len(scene.points), len(seeds))
    for name in set(report.files) - {"splatseed.json", "images"}:
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "out" / name).read_bytes()


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"num_points": 1, "num_original": 1}', '{"num_points": "x"}', "\xff"]
)
def test_a_manifest_that_does_not_fit_says_nothing(scene, tmp_path, text):
    write_scene(scene, tmp_path / "out")
    (tmp_path / "out" / "splatseed.json").write_text(text, encoding="latin-1")
    assert not load_scene(tmp_path / "out").points.source.any()


def test_a_cloud_that_was_changed_since_is_all_originals(scene, tmp_path):
    write_scene(scene.replace(points=upsample(scene, "linear", ratio=2)), tmp_path / "out")
    manifest = tmp_path / "out" / "splatseed.json"
    facts = json.loads(manifest.read_text())
    manifest.write_text(json.dumps({**facts, "num_points": facts["num_points"] + 1}))
    (tmp_path / "out" / SEEDS).unlink()
    assert not load_scene(tmp_path / "out").points.source.any()
