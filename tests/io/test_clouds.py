"""Clouds of every format come back as others wrote them; damaged ones are refused by name."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.errors import SceneFormatError
from splatseed.io.clouds import open_cloud

from .conftest import TABLES

NUM = 257
GRID = np.array([564000.0, 5932000.0, 87.0])


@pytest.fixture
def points(rng):
    """Positions in millimetres around 0, and bytes."""
    return rng.normal(0, 2, (NUM, 3)).round(3), rng.integers(0, 256, (NUM, 3)).astype(np.uint8)


def read_cloud(path, size=100):
    chunks = list(open_cloud(path).chunks(size))
    assert all(0 < len(chunk) <= size for chunk in chunks)
    rgb = None if chunks[0].rgb is None else np.concatenate([chunk.rgb for chunk in chunks])
    return np.concatenate([chunk.xyz for chunk in chunks]), rgb


def check(path, xyz, rgb, tolerance=1e-9, size=100):
    got_xyz, got_rgb = read_cloud(path, size)
    np.testing.assert_allclose(got_xyz, xyz, atol=tolerance, rtol=0)
    assert (got_rgb is None) == (rgb is None)
    if rgb is not None:
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
    assert (open_cloud(path).count, open_cloud(path).colors) == (NUM, "rgb")
    las.red, las.green, las.blue, las.intensity = np.zeros((4, NUM), np.uint16)
    las.intensity[:] = np.arange(NUM) * 9
    las.withheld = np.arange(NUM) % 2
    las.write(path)
    assert open_cloud(path).colors == "intensity"
    kept, grey = read_cloud(path)
    assert len(kept) == (NUM + 1) // 2
    assert grey[0].tolist() == [0, 0, 0]
    assert grey[-1].tolist() == [255, 255, 255]


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


@pytest.mark.parametrize("name", TABLES)
@settings(max_examples=5, deadline=None)
@given(size=st.integers(1, 99))
def test_one_cloud_of_every_format_in_chunks_of_any_size(name, cloud_files, size):
    path = cloud_files.folder / name
    check(path, cloud_files.xyz, cloud_files.rgb, 1e-6, size)
    assert bool(open_cloud(path).findings) == (name in {"a.xyz", "a.pts"})


def test_glb_of_a_scene(tmp_path, points):
    trimesh = pytest.importorskip("trimesh")
    xyz, rgb = points
    scene = trimesh.Scene([trimesh.PointCloud(xyz, colors=rgb)])
    scene.add_geometry(trimesh.creation.box())  # as cameras are drawn
    shift = np.eye(4)
    shift[:3, 3] = 5
    scene.apply_transform(shift)
    scene.export(tmp_path / "scene.glb")
    check(tmp_path / "scene.glb", xyz + 5, rgb, 1e-5)
    assert open_cloud(tmp_path / "scene.glb").findings[0].kind == "meshes-left-out"


@pytest.mark.parametrize(
    ("block", "expected"),
    [
        (b"\x02abc\x20\x02", b"abcabc"),  # 3 bytes from 3 back
        (b"\x00a\xe0\x05\x00", b"a" * 15),  # 14 bytes from 1 back, which overlap
    ],
)
def test_lzf_references(block, expected):
    from splatseed.io.clouds._kernels import decompress_lzf

    for cut, longer in ((0, 0), (0, 1), (1, 0)):
        out = np.empty(len(expected) + longer, np.uint8)
        complete = decompress_lzf(np.frombuffer(block[: len(block) - cut], np.uint8), out)
        assert complete == (not cut and not longer)
        assert not complete or out.tobytes() == expected


@pytest.mark.parametrize(
    ("name", "header", "delimiter", "colors"),
    [
        ("a.txt", "//X Y Z Red Green Blue", " ", True),
        ("a.asc", None, "\t", True),
        ("b.csv", "Easting;Northing;Height", ";", False),
        ("c.csv", "x;y;z", ";", False),  # with decimal commas
    ],
)
def test_text_of_several_writers(tmp_path, points, name, header, delimiter, colors):
    xyz, rgb = points
    table = np.column_stack([xyz, rgb]) if colors else xyz
    formats = ["%.3f"] * 3 + ["%d"] * (3 * colors)
    path = tmp_path / name
    np.savetxt(path, table, formats, delimiter, header=header or "", comments="")
    if name == "c.csv":
        path.write_text(path.read_text().replace(".", ","))
    check(path, xyz, rgb if colors else None)
    assert bool(open_cloud(path).findings) == (header is None)


def test_normals_are_not_taken_for_colours(tmp_path, points):
    normals = points[0] / np.linalg.norm(points[0], axis=1, keepdims=True)
    path = tmp_path / "a.xyz"
    np.savetxt(path, np.column_stack([points[0], np.abs(normals)]), "%.6f")
    assert open_cloud(path).colors == "none"


def test_intensity_and_normals_may_precede_colours(tmp_path, points):
    xyz, rgb = points
    intensity, upward = np.arange(NUM), np.abs(xyz) / np.linalg.norm(xyz, axis=1, keepdims=True)
    tables = ([xyz, intensity, rgb], [xyz, upward, rgb / 255])
    for table in tables:
        np.savetxt(tmp_path / "a.xyz", np.column_stack(table), "%.6f")
        check(tmp_path / "a.xyz", xyz, rgb)


@pytest.mark.parametrize(
    ("kind", "white", "odd"),
    [
        ("f4", 1, 1.3),  # a filter's overshoot
        ("f4", 255, 280),
        ("f8", 1, np.inf),
        *(("u2", white, None) for white in (255, 1023, 4095, 65535)),
    ],
)
def test_white_of_colours_in_other_types(tmp_path, points, kind, white, odd):
    xyz, rgb = points
    rgb[:2] = 255
    colors = rgb * (white / 255)
    colors[0] = white if odd is None else odd
    names = [*("x", "y", "z"), *("red", "green", "blue")]
    rows = np.empty(NUM, [(name, f"<{'f8' if i < 3 else kind}") for i, name in enumerate(names)])
    for name, column in zip(names, np.column_stack([xyz, colors]).T, strict=True):
        rows[name] = np.rint(column) if kind == "u2" and name in names[3:] else column
    types = {"f4": "float", "f8": "double", "u2": "ushort"}
    header = [f"property {types['f8' if i < 3 else kind]} {name}" for i, name in enumerate(names)]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {NUM}", *header]
    path = tmp_path / "a.ply"
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + rows.tobytes())
    check(path, xyz, rgb)


def test_packed_colours_of_a_text_pcd_may_be_printed_as_integers(tmp_path, points):
    xyz, rgb = points
    bits = rgb @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    printed = {"bits": bits, "opaque": bits | 0xFF << 24, "floats": bits.view(np.float32)}
    for name, values in printed.items():
        rows = [f"{x} {y} {z} {c}" for (x, y, z), c in zip(xyz, values.tolist(), strict=True)]
        head = f"FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nPOINTS {NUM}\nDATA ascii\n"
        (tmp_path / f"{name}.pcd").write_text(head + "\n".join(rows) + "\n")
        check(tmp_path / f"{name}.pcd", xyz, rgb)
    lines = (tmp_path / "floats.pcd").read_text().split("\n")
    path = tmp_path / "lost.pcd"
    path.write_text("\n".join([*lines[:5], f"{lines[5].rpartition(' ')[0]} nan", *lines[6:]]))
    check(path, xyz, np.concatenate([np.full((1, 3), 128), rgb[1:]]))


def test_point_maps_of_networks(tmp_path, rng):
    """VGGT's fields: images have channels before rows; DUSt3R's and MASt3R's have them last."""
    xyz = rng.normal(size=(2, 5, 7, 3)).astype(np.float32)
    rgb = rng.integers(0, 256, xyz.shape).astype(np.uint8)
    confidence = np.full((2, 5, 7), 3.0)
    confidence[1, 2] = 1.0
    planar = np.moveaxis(rgb, -1, 1) / np.float32(255)
    kept = confidence.ravel() > 1
    expected = xyz.reshape(-1, 3)[kept], rgb.reshape(-1, 3)[kept], 1e-6
    np.savez(tmp_path / "v.npz", world_points=xyz, images=planar, world_points_conf=confidence)
    check(tmp_path / "v.npz", *expected)
    np.savez_compressed(tmp_path / "d.npz", pts3d=xyz, imgs=rgb / 255.0, mask=confidence > 1)
    check(tmp_path / "d.npz", *expected)
    by_columns = {"xyz": np.asfortranarray(xyz), "rgb": np.asfortranarray(rgb)}
    np.savez(tmp_path / "f.npz", **by_columns)
    check(tmp_path / "f.npz", xyz.reshape(-1, 3), rgb.reshape(-1, 3), 1e-6)


def test_laz_that_is_cut_short(tmp_path, rng):
    laspy = pytest.importorskip("laspy")
    las = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    las.x, las.y, las.z = rng.normal(size=(3, 60000))
    path = tmp_path / "scan.laz"
    las.write(path)
    for keep in (0.98, 0.2):
        path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
        with pytest.raises(SceneFormatError, match="complete LAS or LAZ file"):
            read_cloud(path, 1000)
