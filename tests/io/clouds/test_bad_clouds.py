"""Damaged clouds are refused in one sentence that names the file."""

from __future__ import annotations

import io

import numpy as np
import pytest

from splatseed.errors import MissingDependencyError, SceneFormatError, SceneNotFoundError
from splatseed.io.clouds import open_cloud


def drain(path):
    for _ in open_cloud(path).chunks(64):
        pass


def archive(**arrays):
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


PLY = (
    "ply\nformat {} 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    "property float z\nend_header\n"
)
PCD = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 9\nDATA binary\n"
ROWS = "1 2 3\n"


@pytest.mark.parametrize(
    ("name", "data", "found"),
    [
        ("a.ply", PLY.format("binary_little_endian").encode() + bytes(35), "cut short"),
        ("a.ply", (PLY.format("ascii") + ROWS).encode(), "found 1"),
        ("a.e57", b"no scan" * 1000, ""),
        ("a.xyz", (70000 * ROWS + "1 two 3").encode(), "row 70,001 of .*'1 two 3'"),
        ("a.txt", b"", ""),
        ("a.txt", b"hello\nworld\n", ""),
        ("a.txt", b"1 2\n3 4\n", ""),
        ("a.npz", archive(depth=np.zeros((3, 4))), "depth"),
        ("a.npz", archive(xyz=np.zeros((3, 3)))[:100], ""),
        ("a.glb", b"", ""),
        ("a.glb", b"glTF", ""),
        ("a.glb", b"glTF\x02\x00\x00\x00" + bytes(60), ""),
        ("a.pcd", b"", ""),
        ("a.pcd", PCD, "cut short"),
        ("a.jpg", b"", ""),
    ],
)
def test_bad_files_are_named(tmp_path, name, data, found):
    if name == "a.e57":
        pytest.importorskip("pye57")
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(SceneFormatError, match=found or None) as caught:
        drain(path)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
    assert path.exists()  # pye57 removes what it cannot open


@pytest.mark.parametrize("keep", [0.2, 0.98])
def test_laz_that_is_cut_short(tmp_path, rng, keep):
    laspy = pytest.importorskip("laspy")
    las = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    las.x, las.y, las.z = rng.normal(size=(3, 60000))
    path = tmp_path / "scan.laz"
    las.write(path)
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.raises(SceneFormatError, match="complete LAS or LAZ file"):
        drain(path)


def test_a_missing_file_and_a_missing_package_are_named(tmp_path, monkeypatch):
    with pytest.raises(SceneNotFoundError, match=r"none\.las"):
        drain(tmp_path / "none.las")
    monkeypatch.setattr("splatseed.requirements.find_spec", lambda _: None)
    (tmp_path / "a.laz").write_bytes(b"LASF")
    with pytest.raises(MissingDependencyError, match=r"pip install .*'laspy"):
        open_cloud(tmp_path / "a.laz")
