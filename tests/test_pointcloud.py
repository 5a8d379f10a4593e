"""PointCloud holds what it was given, and cannot be changed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from splatseed.errors import OutputError, PointCloudError
from splatseed.pointcloud import ATTRIBUTES, GENERATED, PointCloud


def test_arrays_are_read_only_and_the_callers_stay_writable():
    xyz, rgb = np.zeros((3, 3), np.float32), np.zeros((3, 3), np.uint8)
    cloud = PointCloud(xyz, rgb)
    for array in (cloud.xyz, cloud.rgb, cloud.source):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        cloud.xyz = xyz
    xyz[0], rgb[0] = 1, 1
    assert not cloud.xyz.any()
    assert not cloud.rgb.any()


def test_what_nobody_can_write_to_is_shared_and_all_else_copied():
    cloud = PointCloud(np.zeros((8, 3), np.float32), np.zeros((8, 3), np.uint8))
    for other in (cloud.replace(rgb=cloud.rgb + 1), cloud.select(slice(2, 5))):
        assert np.shares_memory(other.xyz, cloud.xyz)
    held = np.zeros((8, 3), np.float32)
    for given_ in (held[:], np.frombuffer(bytearray(96), np.float32).reshape(8, 3)):
        given_.flags.writeable = False  # another array still can be written to
        assert not np.shares_memory(PointCloud(given_, cloud.rgb).xyz, given_)
    kept = np.frombuffer(bytes(96), np.float32).reshape(8, 3)
    assert np.shares_memory(PointCloud(kept, cloud.rgb).xyz, kept)


def test_clouds_are_equal_by_their_points_and_described_by_their_number(rng):
    xyz, rgb = rng.normal(size=(5, 3)), np.zeros((5, 3), np.uint8)
    xyz[1] = np.nan
    cloud, same = PointCloud(xyz, rgb), PointCloud(xyz, rgb)
    assert cloud == same
    assert hash(cloud) == hash(same)
    others = (cloud.select(slice(4)), cloud.replace(sizes=np.ones(5)), cloud.replace(rgb=rgb + 1))
    assert all(cloud != other for other in (*others, "a cloud"))
    assert repr(others[1]) == "PointCloud(5 points, 5 of them original, sizes)"


def test_distinct_points_are_finite_and_the_first_at_their_position(rng):
    xyz = rng.integers(-2, 3, (500, 3)).astype(np.float32)
    xyz[xyz == 0] *= rng.choice(np.array([1, -1], np.float32), np.count_nonzero(xyz == 0))
    xyz[::50, 0] = np.nan
    xyz[::70, 2] = np.inf
    cloud = PointCloud(xyz, np.zeros((500, 3), np.uint8))
    np.testing.assert_array_equal(cloud.finite, np.isfinite(xyz).all(axis=1))
    seen: set[tuple[float, ...]] = set()
    for i, row in enumerate(map(tuple, xyz.tolist())):
        assert cloud.distinct[i] == (np.isfinite(row).all() and row not in seen)
        seen.add(row)
    assert not cloud.select(slice(0, 0)).distinct.size


@st.composite
def clouds_with_attributes(draw):
    """A cloud that has any of the attributes, known of any of its points."""
    count = draw(st.integers(0, 8))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    values = {name: rng.uniform(0.1, 1.0, (count, *shape)) for name, shape in ATTRIBUTES.items()}
    values["normals"] /= np.linalg.norm(values["normals"], axis=1, keepdims=True)
    for array in values.values():
        array[draw(hnp.arrays(bool, count))] = np.nan
    known = {name: array for name, array in values.items() if draw(st.booleans())}
    source = draw(hnp.arrays(np.uint8, count, elements=st.sampled_from([0, 8, 9])))
    return PointCloud(rng.normal(size=(count, 3)), np.zeros((count, 3), np.uint8), source, **known)


def told_of(cloud):
    """What is known of each point, by its position."""
    unknown = {name: np.full((len(cloud), *shape), np.nan) for name, shape in ATTRIBUTES.items()}
    columns = {**unknown, **cloud.attributes, "source": cloud.source}
    return {
        tuple(xyz): {
            name: np.nan_to_num(values[i], nan=-9.0).tolist() for name, values in columns.items()
        }
        for i, xyz in enumerate(cloud.xyz.tolist())
    }


@settings(deadline=None)
@given(first=clouds_with_attributes(), second=clouds_with_attributes(), data=st.data())
def test_what_is_known_of_a_point_goes_where_it_goes(first, second, data):
    moved = second.replace(xyz=second.xyz + 100)
    both = PointCloud.concatenate(first, moved)
    expected = {**told_of(first), **told_of(moved)}
    assert told_of(both) == expected
    assert set(both.attributes) == set(first.attributes) | set(second.attributes)
    which = data.draw(hnp.arrays(bool, len(both)))
    kept = both.select(which)
    assert kept.num_original == len(kept.originals) == np.count_nonzero(both.source[which] == 0)
    assert not kept.originals.source.any()
    for part in (
        kept,
        kept.originals,
        both.select(both.distinct),
        both.select(slice(None, None, -1)),
    ):
        assert all(expected[place] == told for place, told in told_of(part).items())
        assert set(part.attributes) == set(both.attributes)


@pytest.mark.parametrize(
    ("name", "values", "says"),
    [
        ("xyz", np.zeros((4, 2)), r"\[4, 2\]"),
        ("xyz", np.zeros(3), r"\[3\]"),
        ("xyz", np.zeros((4, 3), complex), "complex"),
        *((name, None, "found None") for name in ("xyz", "rgb")),
        ("rgb", np.zeros((4, 3)), "float64"),
        ("rgb", np.zeros((3, 3), np.uint8), r"found uint8 \[3, 3\]"),
        ("source", np.zeros(3, np.uint8), "one code per point"),
        ("normals", np.zeros(4), r"normals as numbers of shape \[4, 3\]; found float64 \[4\]"),
        ("sizes", np.ones(3), r"sizes as numbers of shape \[4\]; found float64 \[3\]"),
        ("confidence", np.full(4, "1"), "confidence as numbers"),
        ("normals", np.tile([0, 0, 1.1], (4, 1)), r"of length 1.*1\.1\] at point 0 and 3 more"),
        ("normals", np.tile([0, np.nan, 1], (4, 1)), "of length 1.*nan, 1.0"),
        ("sizes", np.array([1, np.nan, 0, 1]), "above 0.*found 0.0 at point 2 and 0 more"),
        ("sizes", np.array([1, 1, 1, np.inf]), "finite.*found inf at point 3"),
        ("sizes", np.array([1, 1e-60, 1, 1]), "above 0.*point 1"),
        ("sizes", np.array([1, 1, 1e60, 1]), "finite.*point 2"),
        ("confidence", np.array([0, 1, 1.01, -1]), "from 0 to 1.*1.01 at point 2 and 1 more"),
    ],
)
def test_arrays_that_do_not_fit(name, values, says):
    fit = {"xyz": np.zeros((4, 3)), "rgb": np.zeros((4, 3), np.uint8)}
    with pytest.raises(PointCloudError, match=says):
        PointCloud(**fit | {name: values})


def test_own_points_come_after_the_others():
    cloud = PointCloud(np.zeros((2, 3)), np.zeros((2, 3), np.uint8), sizes=np.ones(2))
    more = cloud.with_added(np.ones((3, 3)), np.full((3, 3), 9, np.uint8), confidence=np.ones(3))
    assert more.select(slice(2)).replace(confidence=None) == cloud
    assert more.source.tolist() == [0, 0, GENERATED, GENERATED, GENERATED]
    np.testing.assert_array_equal(more.sizes, [1, 1, *[np.nan] * 3])
    np.testing.assert_array_equal(more.confidence, [*[np.nan] * 2, 1, 1, 1])
    with pytest.raises(PointCloudError):
        cloud.with_added(np.ones((3, 3)), np.ones((3, 3)))


def test_a_ply_has_positions_and_colours(tmp_path, rng):
    xyz, rgb = rng.random((5, 3)), rng.integers(0, 255, (5, 3), np.uint8)
    cloud = PointCloud(xyz, rgb, np.full(5, 3))
    path = tmp_path / "new" / "seeds.ply"
    for _ in range(2):  # the second replaces the first
        cloud.write_ply(path)
        assert PointCloud.read_ply(path) == cloud.replace(source=None)
    with pytest.raises(OutputError):
        cloud.write_ply(tmp_path)
