"""Errors are also those that callers expect of Python, and survive the way between processes."""

from __future__ import annotations

import pickle

import pytest

import splatseed as ss
from splatseed import errors
from splatseed.io.ply import read_ply, write_ply
from splatseed.pointcloud import PointCloud


@pytest.mark.parametrize(
    ("kind", "also"),
    [
        (errors.SceneNotFoundError, FileNotFoundError),
        (errors.PointCloudError, ValueError),
        (errors.ParameterError, ValueError),
        (errors.UnknownNameError, KeyError),
    ],
)
def test_an_error_is_also_pythons(kind, also):
    error = kind("a file", found="none", fix="Check the path.")
    assert isinstance(error, also)
    assert isinstance(error, errors.InputError)
    copied = pickle.loads(pickle.dumps(error))  # noqa: S301  (our own)
    for each in (error, copied):
        assert (str(each), each.fix) == ("expected a file; found none. Check the path.", error.fix)


def test_a_missing_scene_keeps_its_own_words(tmp_path):
    """Functions that turn an OSError into another error let it pass."""
    with pytest.raises(FileNotFoundError, match="no such file or folder"):
        ss.load_scene(tmp_path / "none")
    with pytest.raises(FileNotFoundError, match=r"a file at .*none\.ply"):
        read_ply(tmp_path / "none.ply")


def test_the_methods_are_a_mapping():
    assert ss.METHODS.get("mlss") is None
    assert ss.METHODS.get("mlss", 1) == 1
    with pytest.raises(KeyError, match="expected one of the methods linear"):
        ss.METHODS["mlss"]


def test_paths_may_be_text(tmp_path, rng):
    cloud = PointCloud(rng.normal(size=(9, 3)), rng.integers(0, 256, (9, 3)).astype("uint8"))
    write_ply(f"{tmp_path}/a.ply", cloud)
    assert read_ply(f"{tmp_path}/a.ply").originals == cloud
    assert len(ss.load_scene(f"{tmp_path}/a.ply").points) == 9
    assert len(ss.upsample(cloud, "linear", num_points=18.0)) == 18
    with pytest.raises(errors.ParameterError, match="Round it"):
        ss.upsample(cloud, "linear", num_points=18.5)
