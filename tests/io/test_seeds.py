"""What is known of points comes back with them, and is never given to others."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from splatseed import load_scene, upsample, write_scene
from splatseed.errors import SceneNotFoundError
from splatseed.io import load_originals
from splatseed.io.seeds import SEEDS, _read_seeds, saw_all_photographs, was_upsampled, write_seeds
from splatseed.pointcloud import ATTRIBUTES, PointCloud
from splatseed.progress import silent
from splatseed.synthetic import make_capture
from splatseed.training.seeds import seeded
from splatseed.training.settings import TrainSettings

from ..findings import texts
from .checks import EDITS, apply_edits

NORMAL_STEP, CONFIDENCE_STEP = 1e-3, 5e-4
"""Half precision: 11 bits."""


@pytest.fixture(scope="module")
def scene():
    return make_capture(0, 6, 96, 72).scene


@st.composite
def clouds(draw):
    """Distinct points, of which anything may be known or not."""
    count = draw(st.integers(1, 12))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    holes = hnp.arrays(bool, count)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    values = {
        "normals": np.where(draw(holes)[:, None], np.nan, normals),
        "sizes": np.where(draw(holes), np.nan, np.exp(rng.uniform(-30, 30, count))),
        "confidence": np.where(draw(holes), np.nan, rng.random(count)),
    }
    known = {name: values[name] for name in values if draw(st.booleans())}
    source = draw(hnp.arrays(np.uint8, count, elements=st.sampled_from([0, 4, 8, 9, 255])))
    xyz = rng.normal(size=(count, 3)) * draw(st.sampled_from([1e-6, 1.0, 1e6]))
    xyz[0] = [-0.0, 0.0, 1.0]
    return PointCloud(xyz, np.zeros((count, 3), np.uint8), np.sort(source), **known)


def assert_same(actual: PointCloud, expected: PointCloud) -> None:
    """All that is known of any point is known again, as finely as it is kept."""
    np.testing.assert_array_equal(actual.source, expected.source)
    for name, shape in ATTRIBUTES.items():
        unknown = np.full((len(expected), *shape), np.nan)
        now, then = (each.attributes.get(name, unknown) for each in (actual, expected))
        step = {"normals": NORMAL_STEP, "confidence": CONFIDENCE_STEP, "sizes": 0.0}[name]
        np.testing.assert_allclose(now, then, rtol=0, atol=step)


@settings(deadline=None, max_examples=20)
@given(cloud=clouds(), layout=st.sampled_from(["colmap", "transforms"]))
def test_a_scene_keeps_what_is_known_of_its_seeds(scene, tmp_path_factory, cloud, layout):
    folder = tmp_path_factory.mktemp("scene")
    new = cloud.select(cloud.source > 0)
    seeds = PointCloud.concatenate(scene.points, new)
    report = write_scene(scene.replace(points=seeds), folder / "a", format=layout)
    again = load_scene(folder / "a")
    expected = seeds.select(seeds.distinct)
    if layout == "transforms" and expected.normals is not None:  # (x, y, z) -> (x, z, -y)
        expected = expected.replace(normals=expected.normals[:, [0, 2, 1]] * [1, 1, -1])
    assert_same(again.points, expected)
    assert again.tracks is None or len(again.tracks) == len(scene.points)
    write_scene(again, folder / "b", format=layout)
    files = [folder / part / SEEDS for part in "ab" if SEEDS in report.files]
    assert len({path.read_bytes() for path in files}) == bool(files)


LYING = b"\x93NUMPY\x01\x00v\x00" + (
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }".ljust(117) + b"\n"
)
SPOILT = {
    "short": {"sizes": np.ones(2, np.float32)},
    "wide": {"sizes": np.ones((3, 2), np.float32)},
    "objects": {"sizes": np.array([None] * 3)},
    "negative": {"sizes": -np.ones(3, np.float32)},
}


CLOUD = PointCloud(np.eye(3), np.zeros((3, 3), np.uint8), sizes=np.ones(3))


@pytest.mark.parametrize(
    "how", [*SPOILT, b"", b"PK\x05\x06" + bytes(18), b"not an archive", "a lying header"]
)
def test_damaged_files_are_left_aside_and_told_of(tmp_path, how):
    write_seeds(tmp_path, CLOUD)
    assert "other points" in _read_seeds(tmp_path, PointCloud(2 * CLOUD.xyz, CLOUD.rgb))[1][0].text
    assert _read_seeds(tmp_path, PointCloud(CLOUD.xyz, 255 - CLOUD.rgb))[0].keys() == {"sizes"}
    with np.load(tmp_path / SEEDS) as archive:
        arrays = dict(archive)
    if isinstance(how, bytes):
        (tmp_path / SEEDS).write_bytes(how)
    elif how in SPOILT:
        np.savez_compressed(tmp_path / SEEDS, **arrays | SPOILT[how])
    else:
        np.savez(tmp_path / SEEDS, digest=arrays["digest"])
        with zipfile.ZipFile(tmp_path / SEEDS, "a") as archive:
            archive.writestr("sizes.npy", LYING + bytes(12))
    known, (told,) = _read_seeds(tmp_path, CLOUD.replace(sizes=None))
    assert known == {}
    assert f"{SEEDS} was ignored" in told.text


@settings(deadline=None, max_examples=40)
@given(EDITS)
def test_damage_anywhere_never_escapes(tmp_path_factory, edits):
    folder = tmp_path_factory.mktemp("damage")
    write_seeds(folder, CLOUD)
    (folder / SEEDS).write_bytes(apply_edits((folder / SEEDS).read_bytes(), edits))
    sizes = _read_seeds(folder, CLOUD.replace(sizes=None))[0].get("sizes")
    assert sizes is None or np.array_equal(sizes, np.ones(3))  # a checksum guards each array


def test_without_its_record_every_point_is_an_original(scene, tmp_path):
    """The counts in splatseed.json are not read back."""
    seeds = upsample(scene, "linear", ratio=2)
    write_scene(scene.with_points(seeds), tmp_path / "out")
    assert load_scene(tmp_path / "out").points.num_original == len(scene.points)
    (tmp_path / "out" / SEEDS).unlink()
    assert load_scene(tmp_path / "out").points.num_original == len(seeds)


def test_a_scene_without_originals_keeps_what_its_points_are(scene, tmp_path):
    new = scene.points.replace(source=np.full(len(scene.points), 6, np.uint8))
    report = write_scene(scene.replace(points=new, tracks=None), tmp_path / "out")
    again = load_scene(tmp_path / "out")
    assert set(again.points.source) == {6}
    assert was_upsampled(again)
    assert len(again.points.references) == len(new)
    write_scene(again, tmp_path / "again")
    for name in set(report.files) - {"splatseed.json", "images"}:
        there = (tmp_path / "again" / name).read_bytes()
        assert there == (tmp_path / "out" / name).read_bytes()
    bare = load_originals(tmp_path / "out", require_points=False)
    assert not len(bare.points)
    assert f"{len(new):,} points" in texts(bare)[-1]
    with pytest.raises(SceneNotFoundError, match=f"found none: it made all {len(new):,}"):
        load_originals(tmp_path / "out")


@pytest.mark.parametrize(
    ("told", "all_of_them"),
    [
        ({"command": "upsample", "parameters": {"test_every": 0}}, True),
        ({"command": "upsample", "parameters": {"hold_out": 0}}, True),  # as early outputs have it
        ({"command": "upsample", "parameters": {"test_every": 8}}, False),
        (
            {"command": "upsample", "parameters": {"test_every": 0}, "listed_tests_held_out": True},
            False,
        ),
        ({"command": "upsample", "parameters": {"k": 16}}, False),  # not made from photographs
        ({"command": "upsample"}, False),
        ({"command": "write_scene", "parameters": {"test_every": 0}}, False),
    ],
)
def test_seeds_that_saw_the_test_views_are_known(scene, tmp_path, told, all_of_them):
    seeds = upsample(scene, "linear", ratio=2)
    write_scene(scene.replace(points=seeds), tmp_path / "out", provenance=told)
    again, notes = load_scene(tmp_path / "out"), []
    assert saw_all_photographs(again) == all_of_them
    seeded(again, TrainSettings(seeding="scene"), "cpu", notes.append, silent)
    assert any(each.kind == "seeds-of-test-views" for each in notes) == all_of_them
    assert not saw_all_photographs(scene)
    for text in ("", "[]", '{"num_points": 1, "num_original": 1}', '{"num_points": "x"}'):
        (tmp_path / "out/splatseed.json").write_text(text)
        assert not saw_all_photographs(load_scene(tmp_path / "out"))
