"""Which columns of a text cloud are colours, by their values, or as they are named."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.errors import ParameterError, SceneFormatError
from splatseed.io.clouds import open_cloud
from splatseed.io.clouds.columns import possible_columns

NUM = 3000
RNG = np.random.default_rng(3)
XYZ = RNG.normal(size=(NUM, 3))
BASE = RNG.normal(128, 50, NUM)


def levels(values):
    return np.clip(np.rint(values), 0, 255)


# Channels of a photograph follow each other; those of a made texture hardly do.
NATURAL = levels(np.stack([BASE + RNG.normal(0, s, NUM) for s in (12, 8, 14)], axis=1))
MADE = levels(RNG.normal(128, 50, (NUM, 3)) + 0.3 * (BASE[:, None] - 128))
GREY = np.repeat(levels(BASE)[:, None], 3, axis=1)
LASER = levels(100 + 0.3 * (BASE - 128) + RNG.normal(0, 30, NUM))
LABELS = RNG.integers(0, 9, NUM).astype(float)
NORMALS = XYZ / np.linalg.norm(XYZ, axis=1, keepdims=True)


def starts(*columns):
    """The possible first columns of colours, counted after x, y, z."""
    names = possible_columns(np.column_stack([XYZ, *columns]), is_pts=False)
    return [each.index("red") - 3 if "red" in each else None for each in names]


@pytest.mark.parametrize("rgb", [NATURAL, MADE, GREY], ids=["natural", "made", "grey"])
@pytest.mark.parametrize(
    "intensity",
    [
        lambda rgb: levels(rgb @ (0.299, 0.587, 0.114)),
        lambda rgb: np.floor(rgb.mean(axis=1)),
        lambda rgb: levels(0.6 * rgb.mean(axis=1) + 20),
        lambda rgb: rgb.mean(axis=1) * 16 - 2048,  # as Leica's
        lambda _: LABELS,
        lambda _: np.full(NUM, 255.0),  # alpha
    ],
)
def test_intensity_or_labels_before_and_after_colours(rgb, intensity):
    other = intensity(rgb)
    equal = (rgb == other[:, None]).all()  # then either is right
    assert starts(other, rgb) == [0 if equal else 1]
    assert starts(rgb, other) == [0]
    assert starts(rgb / 255) == [0]
    assert starts(257 * rgb) == [0]


def test_intensity_of_a_laser_is_told_by_how_little_it_follows_the_colours():
    for rgb in (NATURAL, GREY):
        assert starts(LASER, rgb) == [1]
        assert starts(rgb, LASER) == [0]


def test_what_values_do_not_tell_is_left_open():
    noisy = levels(NATURAL.mean(axis=1) + RNG.normal(0, 10, NUM))
    assert starts(noisy, NATURAL) == starts(NATURAL, noisy) == [0, 1]
    assert starts(LASER, MADE) == [0, 1]
    assert len(starts(NATURAL, MADE)) > 1
    few = np.column_stack([XYZ, LASER, NATURAL])[:50]
    assert len(possible_columns(few, is_pts=False)) == 2


def test_other_columns():
    black = np.zeros((NUM, 3))
    assert starts(NORMALS, MADE) == [3]
    assert starts(MADE, NORMALS) == [0]
    assert starts(black) == [0]
    assert starts(LASER, black) == [1]
    assert starts(LASER, LABELS, LABELS) == [None]  # returns and classes
    assert starts(LABELS, LABELS, LABELS) == [None]
    assert starts(NORMALS) == [None]


def test_columns_as_the_caller_names_them(tmp_path):
    xyz, rgb, path = XYZ[:400], NATURAL[:400].astype(int), tmp_path / "a.xyz"
    noisy = levels(rgb.mean(axis=1) + RNG.normal(0, 10, 400))
    np.savetxt(path, np.column_stack([noisy, xyz, rgb]), "%.6g")
    np.savetxt(tmp_path / "b.xyz", np.column_stack([xyz, noisy, rgb]), "%.6g")
    with pytest.raises(SceneFormatError, match=r"4 to 6 or 5 to 7.*'x y z _ r g b'"):
        open_cloud(tmp_path / "b.xyz")
    for columns in ("_ x y z r g b", ("i", "X", "Y", "Z", "red", "green", "blue")):
        cloud = open_cloud(path, columns)
        chunk = next(cloud.chunks())
        np.testing.assert_allclose(chunk.xyz, xyz, atol=1e-4)
        np.testing.assert_array_equal(chunk.rgb, rgb)
        assert not cloud.findings
    swapped = next(open_cloud(path, "_ x y z b g r").chunks())
    np.testing.assert_array_equal(swapped.rgb, rgb[:, ::-1])
    for columns in ("x y z r g b", "_ x y z r g _", "_ x y z r g class", "_ x x z r g b"):
        with pytest.raises(ParameterError, match=r"cloud\.columns"):
            open_cloud(path, columns)
