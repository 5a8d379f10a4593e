"""Clouds of every format, written by others, come back as they were written."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.io.clouds import open_cloud

NUM = 257
GRID = np.array([564000.0, 5932000.0, 87.0])


@pytest.fixture
def points(rng):
    """Positions in millimetres around 0, and bytes."""
    return rng.normal(0, 2, (NUM, 3)).round(3), rng.integers(0, 256, (NUM, 3)).astype(np.uint8)


def whole(path, size=100):
    chunks = list(open_cloud(path).chunks(size))
    assert all(0 < len(chunk) <= size for chunk in chunks)
    rgb = None if chunks[0].rgb is None else np.concatenate([chunk.rgb for chunk in chunks])
    return np.concatenate([chunk.xyz for chunk in chunks]), rgb


def check(path, xyz, rgb, tolerance=1e-9):
    got_xyz, got_rgb = whole(path)
    np.testing.assert_allclose(got_xyz, xyz, atol=tolerance, rtol=0)
    if rgb is None:
        assert got_rgb is None
    else:
        np.testing.assert_array_equal(got_rgb, rgb)


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("factor", [1, 257])
def test_las_of_a_national_grid_in_8_and_16_bits(tmp_path, points, suffix, factor):
    laspy = pytest.importorskip("laspy")
    xyz, rgb = points[0] + GRID, points[1]
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 0.001), GRID
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.red, las.green, las.blue = rgb.astype(np.uint16).T * factor
    path = tmp_path / f"scan.{suffix}"
    las.write(path)
    check(path, xyz, rgb, 1e-6)
    cloud = open_cloud(path)
    assert (cloud.count, cloud.colors) == (NUM, "rgb")
    np.testing.assert_allclose(cloud.bounds, [xyz.min(axis=0), xyz.max(axis=0)], atol=1e-6)


def test_las_points_that_are_withheld_are_left_out(tmp_path, points):
    laspy = pytest.importorskip("laspy")
    las = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    las.x, las.y, las.z = points[0].T
    las.withheld = np.arange(NUM) % 2
    path = tmp_path / "scan.las"
    las.write(path)
    assert len(whole(path)[0]) == (NUM + 1) // 2


def test_e57_scans_stand_where_their_poses_say(tmp_path, points):
    pye57 = pytest.importorskip("pye57")
    xyz, rgb = points
    fields = {f"cartesian{axis}": xyz[:, i].copy() for i, axis in enumerate("XYZ")}
    fields |= {f"color{name}": rgb[:, i].copy() for i, name in enumerate(("Red", "Green", "Blue"))}
    path = tmp_path / "scan.e57"
    file = pye57.E57(str(path), mode="w")
    half = np.sqrt(0.5)  # a quarter turn about z
    turn, place = np.array([half, 0, 0, half]), np.array([10.0, 20.0, 30.0])
    file.write_scan_raw(fields)
    file.write_scan_raw(fields, rotation=turn, translation=place)
    file.close()
    turned = np.stack([-xyz[:, 1], xyz[:, 0], xyz[:, 2]], axis=1) + place
    check(path, np.concatenate([xyz, turned]), np.concatenate([rgb, rgb]), 1e-5)


def test_ply_and_glb_of_trimesh(tmp_path, points):
    trimesh = pytest.importorskip("trimesh")
    xyz, rgb = points
    cloud = trimesh.PointCloud(xyz, colors=rgb)
    for name, options in (("b.ply", {}), ("a.ply", {"encoding": "ascii"}), ("c.glb", {})):
        cloud.export(tmp_path / name, **options)
        check(tmp_path / name, xyz, rgb, 1e-6)


def test_glb_leaves_out_the_cameras_drawn_beside_points(tmp_path, points):
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.Scene([trimesh.PointCloud(points[0], colors=points[1])])
    scene.add_geometry(trimesh.creation.box())
    shift = np.eye(4)
    shift[:3, 3] = 5
    scene.apply_transform(shift)
    scene.export(tmp_path / "scene.glb")
    check(tmp_path / "scene.glb", points[0] + 5, points[1], 1e-5)
    assert "meshes are left out" in open_cloud(tmp_path / "scene.glb").warnings[0]


def test_ply_properties_in_any_order(tmp_path, points):
    xyz, rgb = points
    rows = np.zeros(NUM, [("blue", "u1"), ("z", ">f8"), ("x", ">f8"), ("nx", ">f4"),
                          ("green", "u1"), ("y", ">f8"), ("red", "u1")])  # fmt: skip
    for i, axis in enumerate("xyz"):
        rows[axis] = xyz[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        rows[name] = rgb[:, i]
    kinds = {"u1": "uchar", "f8": "double", "f4": "float"}
    named = ((name, rows.dtype[name].str[1:]) for name in rows.dtype.names)
    lines = [f"property {kinds[kind]} {name}" for name, kind in named]
    head = "\n".join(["ply", "format binary_big_endian 1.0", f"element vertex {NUM}", *lines])
    (tmp_path / "a.ply").write_bytes(f"{head}\nend_header\n".encode() + rows.tobytes())
    check(tmp_path / "a.ply", xyz, rgb)


def pcd_header(kind, packed):
    fields = "x y z rgb" if packed else "x y z"
    count = 4 if packed else 3
    return (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE{' 4' * count}\nTYPE{' F' * count}\n"
        f"COUNT{' 1' * count}\nWIDTH {NUM}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {NUM}\n"
        f"DATA {kind}\n"
    ).encode()


def literal_lzf(data):
    """LZF without any references."""
    return b"".join(
        bytes([len(p) - 1]) + p for p in (data[i : i + 32] for i in range(0, len(data), 32))
    )


def test_pcd_binary_ascii_and_compressed(tmp_path, points):
    xyz, rgb = points[0].astype(np.float32), points[1]
    bits = (rgb.astype(np.uint32) << np.array([16, 8, 0], np.uint32)).sum(axis=1, dtype=np.uint32)
    table = np.column_stack([xyz, bits.view(np.float32)])
    (tmp_path / "b.pcd").write_bytes(pcd_header("binary", True) + table.tobytes())
    text = "\n".join(" ".join(repr(float(v)) for v in row) for row in table)
    (tmp_path / "a.pcd").write_bytes(pcd_header("ascii", True) + text.encode())
    data = table.T.tobytes()
    packed = literal_lzf(data)
    sizes = struct.pack("<II", len(packed), len(data))
    (tmp_path / "c.pcd").write_bytes(pcd_header("binary_compressed", True) + sizes + packed)
    for name in ("a", "b", "c"):
        check(tmp_path / f"{name}.pcd", xyz, rgb, 1e-6)


@pytest.mark.parametrize(
    ("block", "expected"),
    [
        (b"\x02abc\x20\x02", b"abcabc"),  # 3 bytes from 3 back
        (b"\x00a\xe0\x05\x00", b"a" * 15),  # 14 bytes from 1 back, which overlap
    ],
)
def test_lzf_references(block, expected):
    from splatseed.io.clouds.pcd import _decompress

    def decompress(block, size):
        out = np.empty(size, np.uint8)
        return out.tobytes() if _decompress(np.frombuffer(block, np.uint8), out) else None

    assert decompress(block, len(expected)) == expected
    assert decompress(block, len(expected) + 1) is None
    assert decompress(block[:-1], len(expected)) is None


@pytest.mark.parametrize(
    ("name", "header", "delimiter", "colors"),
    [
        ("a.csv", "X,Y,Z,R,G,B", ",", True),
        ("a.txt", "//X Y Z Red Green Blue", " ", True),
        ("a.xyz", None, " ", True),
        ("a.asc", None, "\t", True),
        ("b.csv", "Easting;Northing;Height", ";", False),
    ],
)
def test_text_of_several_writers(tmp_path, points, name, header, delimiter, colors):
    xyz, rgb = points
    columns = np.column_stack([xyz, rgb]) if colors else xyz
    formats = ["%.3f"] * 3 + ["%d"] * (3 * colors)
    path = tmp_path / name
    np.savetxt(path, columns, formats, delimiter, header=header or "", comments="")
    check(path, xyz, rgb if colors else None)
    assert bool(open_cloud(path).warnings) == (header is None)


def test_decimal_commas(tmp_path, points):
    path = tmp_path / "a.csv"
    rows = [";".join(f"{value:.3f}".replace(".", ",") for value in row) for row in points[0]]
    path.write_text("x;y;z\n" + "\n".join(rows))
    check(path, points[0], None)


def test_pts_has_its_count_first_and_intensity_before_colours(tmp_path, points):
    xyz, rgb = points
    path = tmp_path / "a.pts"
    table = np.column_stack([xyz, np.full(NUM, -900), rgb])
    np.savetxt(path, table, ["%.3f"] * 3 + ["%d"] * 4, header=str(NUM), comments="")
    check(path, xyz, rgb)


def test_normals_are_not_taken_for_colours(tmp_path, points):
    normals = points[0] / np.linalg.norm(points[0], axis=1, keepdims=True)
    path = tmp_path / "a.xyz"
    np.savetxt(path, np.column_stack([points[0], np.abs(normals)]), "%.6f")
    assert open_cloud(path).colors == "none"


def test_point_maps_of_networks(tmp_path, rng):
    """VGGT's fields: images have channels before rows; DUSt3R's and MASt3R's have them last."""
    xyz = rng.normal(size=(2, 5, 7, 3)).astype(np.float32)
    rgb = rng.integers(0, 256, xyz.shape).astype(np.uint8)
    confidence = np.full((2, 5, 7), 3.0)
    confidence[1, 2] = 1.0
    planar = np.moveaxis(rgb, -1, 1) / np.float32(255)
    np.savez(tmp_path / "v.npz", world_points=xyz, images=planar, world_points_conf=confidence)
    kept = confidence.ravel() > 1
    check(tmp_path / "v.npz", xyz.reshape(-1, 3)[kept], rgb.reshape(-1, 3)[kept], 1e-6)
    np.savez_compressed(tmp_path / "d.npz", pts3d=xyz, imgs=rgb / 255.0, mask=confidence > 1)
    check(tmp_path / "d.npz", xyz.reshape(-1, 3)[kept], rgb.reshape(-1, 3)[kept], 1e-6)


def test_an_array_stored_column_by_column(tmp_path, points):
    np.savez(tmp_path / "f.npz", xyz=np.asfortranarray(points[0]), rgb=np.asfortranarray(points[1]))
    check(tmp_path / "f.npz", *points)


@settings(max_examples=20, deadline=None)
@given(size=st.integers(1, 300), name=st.sampled_from(["a.ply", "a.xyz", "a.npz"]))
def test_chunks_of_any_size_hold_the_same(tmp_path_factory, size, name):
    path = tmp_path_factory.getbasetemp() / f"sizes_{name}"
    xyz = np.random.default_rng(3).normal(size=(199, 3)).astype(np.float32)
    if not path.exists():
        if name == "a.npz":
            np.savez(path, xyz=xyz)
        elif name == "a.xyz":
            np.savetxt(path, xyz, "%.9g")
        else:
            head = "ply\nformat binary_little_endian 1.0\nelement vertex 199\nproperty float x\n"
            rest = "property float y\nproperty float z\nend_header\n"
            path.write_bytes((head + rest).encode() + xyz.tobytes())
    np.testing.assert_array_equal(whole(path, size)[0].astype(np.float32), xyz)
