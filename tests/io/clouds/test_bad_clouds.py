"""Damaged clouds are refused in one sentence that names the file."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.errors import MissingDependencyError, SceneFormatError, SceneNotFoundError
from splatseed.io.clouds import open_cloud


def drain(path):
    for _ in open_cloud(path).chunks(64):
        pass


def refused(path, match, error=SceneFormatError):
    with pytest.raises(error, match=match) as caught:
        drain(path)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("keep", [0.2, 0.6, 0.98])
def test_laz_that_is_cut_short(tmp_path, rng, keep):
    laspy = pytest.importorskip("laspy")
    las = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    las.x, las.y, las.z = rng.normal(size=(3, 60000))
    path = tmp_path / "scan.laz"
    las.write(path)
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    refused(path, "complete LAS or LAZ file")


def test_binary_ply_that_is_cut_short(tmp_path):
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 100\nproperty float x\n"
    path = tmp_path / "a.ply"
    path.write_bytes(
        (head + "property float y\nproperty float z\nend_header\n").encode() + bytes(99)
    )
    refused(path, "cut short")


def test_ascii_ply_with_fewer_lines_than_promised(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    path = tmp_path / "a.ply"
    path.write_text(head + "property float z\nend_header\n1 2 3\n")
    refused(path, "3 points in .*found 1")


def test_e57_that_is_none(tmp_path):
    pytest.importorskip("pye57")
    path = tmp_path / "a.e57"
    path.write_bytes(b"no scan" * 1000)
    refused(path, "complete E57 file")
    assert path.exists()


def test_a_word_among_numbers_is_named_with_its_row(tmp_path):
    path = tmp_path / "a.xyz"
    path.write_text("\n".join(["1 2 3"] * 70000 + ["1 two 3"]))
    refused(path, "row 70,001 of .*'1 two 3'")


@pytest.mark.parametrize("content", ["", "hello\nworld\n", "1 2\n3 4\n"])
def test_text_without_points(tmp_path, content):
    path = tmp_path / "a.txt"
    path.write_text(content)
    refused(path, "a point per line")


def test_archives(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, depth=np.zeros((3, 4)))
    refused(path, "hold points: one of world_points")
    path.write_bytes(path.read_bytes()[:100])
    refused(path, "archive of NumPy arrays")


@pytest.mark.parametrize("data", [b"", b"glTF", b"glTF\x02\x00\x00\x00" + bytes(60)])
def test_glb_that_is_none(tmp_path, data):
    path = tmp_path / "a.glb"
    path.write_bytes(data)
    refused(path, "complete .glb file")


@pytest.mark.parametrize(
    "data", [b"", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 9\nDATA binary\n"]
)
def test_pcd_that_is_none_or_short(tmp_path, data):
    path = tmp_path / "a.pcd"
    path.write_bytes(data)
    refused(path, "PCD header|cut short")


def test_other_names_and_no_file(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"")
    refused(tmp_path / "a.jpg", "to be a cloud: .las, .laz")
    refused(tmp_path / "none.las", "no such file", SceneNotFoundError)


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("splatseed.requirements.find_spec", lambda _: None)
    (tmp_path / "a.laz").write_bytes(b"LASF")
    with pytest.raises(MissingDependencyError, match=r"pip install .*'laspy"):
        open_cloud(tmp_path / "a.laz")
