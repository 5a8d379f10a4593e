"""Whatever bytes a cloud has, its points are read or one of our own errors names it.

Readers of others can do worse than raise: lazrs ends the process when a table of chunks promises
more than memory holds, and laspy looks for as many records as a header promises.
"""

from __future__ import annotations

import struct
from functools import partial

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from splatseed.errors import SceneFormatError, SplatseedError
from splatseed.io.clouds import open_cloud

from ..fuzzing import assert_only_our_errors

NAMES = (
    *("a.las", "a.laz", "new.laz", "a.e57", "a.ply", "text.ply", "a.glb", "a.npz", "packed.npz"),
    *("a.pcd", "text.pcd", "packed.pcd", "a.xyz", "a.csv", "a.pts"),
)
PCD = "FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 60\nHEIGHT 1\nDATA "
NUM = 60


def drain(path):
    for chunk in open_cloud(path).chunks(50):
        assert len(chunk) <= 50


def write_las(path, xyz, point_format, version):
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    las = laspy.LasData(laspy.LasHeader(point_format=point_format, version=version))
    las.x, las.y, las.z = xyz.T
    las.write(path)


def write_pcds(folder, xyz):
    rows = np.zeros(NUM, [("xyz", "<f4", 3), ("rgb", "<u4")])
    rows["xyz"] = xyz
    (folder / "a.pcd").write_bytes(f"{PCD}binary\n".encode() + rows.tobytes())
    lines = "\n".join("{:.4f} {:.4f} {:.4f} 0".format(*row) for row in xyz)
    (folder / "text.pcd").write_text(f"{PCD}ascii\n{lines}\n")
    columns = np.ascontiguousarray(rows["xyz"].T).tobytes() + rows["rgb"].tobytes()
    # LZF of literal runs: a run of n bytes begins with n - 1.
    runs = b"".join(
        bytes([len(run) - 1]) + run
        for run in (columns[at : at + 32] for at in range(0, len(columns), 32))
    )
    body = struct.pack("<II", len(runs), len(columns)) + runs
    (folder / "packed.pcd").write_bytes(f"{PCD}binary_compressed\n".encode() + body)


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """A small cloud in each format, as bytes; reading them also loads what readers need."""
    pye57, trimesh = pytest.importorskip("pye57"), pytest.importorskip("trimesh")
    folder, rng = tmp_path_factory.mktemp("clouds"), np.random.default_rng(0)
    xyz, rgb = rng.normal(size=(NUM, 3)), rng.integers(0, 256, (NUM, 3))
    for name, point_format, version in (
        ("a.las", 3, "1.2"),
        ("a.laz", 3, "1.2"),
        ("new.laz", 7, "1.4"),
    ):
        write_las(folder / name, xyz, point_format, version)
    file = pye57.E57(str(folder / "a.e57"), mode="w")
    file.write_scan_raw({f"cartesian{axis}": xyz[:, i].copy() for i, axis in enumerate("XYZ")})
    file.close()
    cloud = trimesh.PointCloud(xyz, colors=rgb.astype(np.uint8))
    cloud.export(folder / "a.ply")
    cloud.export(folder / "text.ply", encoding="ascii")
    cloud.export(folder / "a.glb")
    np.savez(folder / "a.npz", xyz=xyz, rgb=rgb.astype(np.uint8))
    maps = {"pts3d": np.asfortranarray(xyz.reshape(6, 10, 3)), "conf": np.ones((6, 10))}
    np.savez_compressed(folder / "packed.npz", **maps)
    write_pcds(folder, xyz)
    np.savetxt(folder / "a.xyz", xyz)
    np.savetxt(folder / "a.csv", xyz, delimiter=",", header="x,y,z", comments="")
    np.savetxt(folder / "a.pts", np.hstack([xyz, rgb]), header=str(NUM), comments="")
    for name in NAMES:
        drain(folder / name)
    return {name: (folder / name).read_bytes() for name in NAMES}


@st.composite
def damages(draw, data):
    """The bytes with a few changed, repeated, cut out or all from somewhere on."""
    damaged = bytearray(data)
    for _ in range(draw(st.integers(1, 3))):
        # Headers are where it hurts, and tables at the end.
        at = draw(st.integers(0, min(len(damaged), draw(st.sampled_from([100, 400, 10**9])))))
        if draw(st.booleans()):
            at = max(len(damaged) - at, 0)
        patch = draw(st.binary(max_size=4) | st.sampled_from([b"\xff" * 4, bytes(4), b"999999"]))
        cut = draw(st.sampled_from([len(patch), len(patch), 0, 3, len(damaged)]))
        damaged[at : at + cut] = patch
    return bytes(damaged)


@pytest.mark.parametrize("name", NAMES)
@settings(
    max_examples=100,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(data=st.data())
def test_damage_is_told_or_harmless(name, tmp_path, little_memory, data, valid):
    damaged = data.draw(damages(valid[name]))
    # Text is read in blocks of 16 MB.
    assert_only_our_errors(drain, tmp_path / name, damaged, partial(little_memory, 64 << 20))


def too_many_chunks(data):
    (points,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, points)
    struct.pack_into("<I", data, table + 4, 2**32 - 1)


def a_longer_point(data):
    """Else lazrs makes room for what its own record says."""
    at = data.index(b"laszip encoded") + 16 + 2 + 2 + 32 + 34
    assert struct.unpack_from("<HH", data, at) == (6, 20)  # the first item: POINT10, 20 bytes
    struct.pack_into("<H", data, at + 2, 2**16 - 1)


@pytest.mark.parametrize(
    ("name", "lie"),
    [
        ("a.laz", too_many_chunks),
        ("new.laz", too_many_chunks),
        ("a.laz", a_longer_point),
        ("a.las", lambda data: struct.pack_into("<I", data, 100, 2**32 - 1)),  # records
        ("a.las", lambda data: struct.pack_into("<I", data, 96, 2**32 - 1)),  # points begin there
        ("a.pcd", lambda data: data.__setitem__(slice(None), data.replace(b"T 1 1", b"T 2 1"))),
    ],
)
def test_a_header_is_not_believed(name, lie, valid, tmp_path):
    data = bytearray(valid[name])
    lie(data)
    (tmp_path / name).write_bytes(data)
    with pytest.raises(SceneFormatError, match=name):
        drain(tmp_path / name)


def test_a_panic_of_lazrs_is_an_error_of_ours(valid, tmp_path, monkeypatch):
    """pyo3 raises what is no Exception."""
    import laspy

    panic = type("PanicException", (BaseException,), {})

    def panicked(*_):
        raise panic("index out of bounds")

    monkeypatch.setattr(laspy.LasReader, "read_points", panicked)
    path = tmp_path / "a.laz"
    path.write_bytes(valid["a.laz"])
    with pytest.raises(SplatseedError, match="index out of bounds"):
        drain(path)
