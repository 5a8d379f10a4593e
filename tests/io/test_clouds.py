"""Clouds of every format come back as others wrote them; damaged ones are refused by name."""

from __future__ import annotations

import json
import struct

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


@pytest.mark.parametrize(("turn", "found"), [((0, 0, 0, 0), True), ((-3, 0, 0, 0), False)])
def test_e57_quaternions_of_any_length_and_zero_for_no_rotation(tmp_path, points, turn, found):
    pye57 = pytest.importorskip("pye57")
    fields = {f"cartesian{axis}": points[0][:, i].copy() for i, axis in enumerate("XYZ")}
    file = pye57.E57(str(tmp_path / "scan.e57"), mode="w")
    file.write_scan_raw(fields, rotation=np.array(turn, float), translation=np.array([0, 0, 5.0]))
    file.close()
    check(tmp_path / "scan.e57", points[0] + (0, 0, 5), None, 1e-5)
    findings = open_cloud(tmp_path / "scan.e57").findings
    assert [each.kind for each in findings] == ["zero-rotation"] * found


def test_e57_by_angles_with_limits_and_invalid_colours(tmp_path):
    """Written node by node: pye57 writes neither. Colours are dark: 16 bits only by their limit."""
    libe57 = pytest.importorskip("pye57").libe57
    path = str(tmp_path / "scan.e57")
    image = libe57.ImageFile(path, "w")
    scan, limits = libe57.StructureNode(image), libe57.StructureNode(image)
    for name in ("Red", "Green", "Blue"):
        limits.set(f"color{name}Maximum", libe57.IntegerNode(image, 65535))
    pose, shift = libe57.StructureNode(image), libe57.StructureNode(image)
    for axis, value in zip("zyx", (3.0, 2.0, 1.0), strict=True):  # in any order
        shift.set(axis, libe57.FloatNode(image, value))
    pose.set("translation", shift)
    kinds = {f"spherical{name}": "d" for name in ("Range", "Azimuth", "Elevation")}
    kinds |= {f"color{name}": "H" for name in ("Red", "Green", "Blue")} | {"isColorInvalid": "b"}
    prototype = libe57.StructureNode(image)
    for name, kind in kinds.items():
        node = libe57.FloatNode(image) if kind == "d" else libe57.IntegerNode(image, 0, 0, 65535)
        prototype.set(name, node)
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    for name, node in (("colorLimits", limits), ("pose", pose), ("points", points)):
        scan.set(name, node)
    scans = libe57.VectorNode(image, True)
    image.root().set("data3D", scans)
    scans.append(scan)
    angle = np.pi / 2
    values = [(2, 2, 2), (0, angle, 0), (0, 0, angle), *[(514, 2570, 1285)] * 3, (0, 1, 0)]
    columns = {n: np.array(v, k) for (n, k), v in zip(kinds.items(), values, strict=True)}
    buffers = libe57.VectorSourceDestBuffer()
    for name, column in columns.items():
        buffers.append(libe57.SourceDestBuffer(image, name, column, 3, True))
    writer = points.writer(buffers)
    writer.write(3)
    writer.close()
    image.close()
    xyz = [[3, 2, 3], [1, 4, 3], [1, 2, 5]]
    check(tmp_path / "scan.e57", xyz, [[2, 2, 2], [0, 0, 0], [5, 5, 5]], 1e-9)


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


def write_glb(path, body, accessors, views, node=None, extensions=()):
    attributes = dict(zip(("POSITION", "COLOR_0"), range(len(accessors)), strict=False))
    content = {
        "asset": {"version": "2.0"}, "extensionsRequired": list(extensions),
        "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, **(node or {})}],
        "meshes": [{"primitives": [{"mode": 0, "attributes": attributes}]}],
        "accessors": accessors, "bufferViews": [{"buffer": 0, **view} for view in views],
        "buffers": [{"byteLength": len(body)}],
    }  # fmt: skip
    text = json.dumps(content).encode()
    text, body = text + b" " * (-len(text) % 4), body + bytes(-len(body) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(body), len(text), 0x4E4F534A)
    path.write_bytes(head + text + struct.pack("<II", len(body), 0x004E4942) + body)


@pytest.mark.parametrize(
    ("component", "kind", "full"),
    [(5120, "i1", 127), (5121, "u1", 255), (5122, "<i2", 32767), (5123, "<u2", 65535)],
)
def test_glb_of_normalised_integers(tmp_path, points, component, kind, full):
    """glTF 2.0, 3.6.2.2: f = c / 255, max(c / 127, -1), c / 65535, max(c / 32767, -1)."""
    info, rgb = np.iinfo(kind), points[1]
    padded = np.zeros((NUM, 4), kind)  # rows of positions begin at multiples of 4 bytes
    padded[:, :3] = np.random.default_rng(0).integers(info.min, info.max + 1, (NUM, 3))
    padded[0, :3], wide = info.min, np.zeros((NUM, 4), "<u2")
    wide[:, :3] = rgb * np.uint16(257)
    body, stride = padded.tobytes() + wide.tobytes(), 4 * padded.itemsize
    write_glb(
        tmp_path / "a.glb",
        body,
        [
            {"bufferView": 0, "componentType": component, "normalized": True, "type": "VEC3"}
            | {"count": NUM},
            {"bufferView": 1, "componentType": 5123, "normalized": True, "type": "VEC4"}
            | {"count": NUM},
        ],
        [
            {"byteLength": NUM * stride, "byteStride": stride},
            {"byteOffset": NUM * stride, "byteLength": NUM * 8},
        ],
        {"scale": [2, 2, 2], "translation": [1, 0, 0]},
        ["KHR_mesh_quantization"],
    )
    xyz = np.maximum(padded[:, :3] / full, -1) * 2 + (1, 0, 0)
    check(tmp_path / "a.glb", xyz, rgb)


@pytest.mark.parametrize("has_base", [True, False])
def test_glb_of_sparse_values(tmp_path, has_base):
    """3.6.2.3: the values at the indices replace those of the view, or zeros without one."""
    base, new = np.arange(30, dtype="<f4").reshape(10, 3), np.full((2, 3), 7.5, "<f4")
    body = base.tobytes() + np.array([1, 9], "<u2").tobytes() + new.tobytes()
    sparse = {"indices": {"bufferView": 1, "componentType": 5123}, "values": {"bufferView": 2}}
    accessor = {"componentType": 5126, "count": 10, "type": "VEC3"}
    accessor |= {"sparse": {"count": 2, **sparse}} | ({"bufferView": 0} if has_base else {})
    views = [(0, 120), (120, 4), (124, 24)]
    views = [{"byteOffset": start, "byteLength": size} for start, size in views]
    write_glb(tmp_path / "a.glb", body, [accessor], views)
    expected = base if has_base else np.zeros_like(base)
    expected[[1, 9]] = 7.5
    check(tmp_path / "a.glb", expected, None, size=4)
    for name, found in (
        ("KHR_draco_mesh_compression", "Draco"),
        ("EXT_meshopt_compression", "meshopt"),
    ):
        write_glb(tmp_path / "a.glb", body, [accessor], views, extensions=[name])
        with pytest.raises(SceneFormatError, match=found):
            open_cloud(tmp_path / "a.glb")


@pytest.mark.parametrize("form", ["ascii", "binary", "Binary_Compressed"])
def test_pcd_of_lower_case_with_fields_in_any_order(tmp_path, points, form):
    xyz, rgb = points[0].astype("<f4"), points[1]
    kind = [("normal", "<f4", 3), ("RGBA", "<u4"), ("Z", "<f4"), ("y", "<f4"), ("X", "<f8")]
    rows = np.zeros(NUM, kind)
    rows["RGBA"] = rgb @ np.array([1 << 16, 1 << 8, 1], np.uint32) | np.uint32(255 << 24)
    rows["X"], rows["y"], rows["Z"] = xyz.T
    head = "# .PCD v0.7\nversion .7\nfields normal RGBA Z y X\nsize 4 4 4 4 8\ntype f u f f f\n"
    head += f"count 3 1 1 1 1\nwidth {NUM}\nheight 1\nviewpoint 0 0 0 1 0 0 0\ndata {form}\n"
    body = rows.tobytes()
    if form == "ascii":
        lines = [f"0 0 0 {c} {z!r} {y!r} {x!r}" for _, c, z, y, x in rows.tolist()]
        body = "\n".join(lines).encode()
    elif form != "binary":
        columns = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name, *_ in kind)
        runs = (columns[at : at + 32] for at in range(0, len(columns), 32))
        packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
        body = struct.pack("<II", len(packed), len(columns)) + packed
    (tmp_path / "a.pcd").write_bytes(head.encode() + body)
    check(tmp_path / "a.pcd", xyz, rgb)


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


def test_text_as_programs_write_it(tmp_path, points):
    """Several scans in a PTS, commas at the ends of lines, a byte order mark, point numbers."""
    xyz, rgb = points
    rows = [
        f"{a[0]} {a[1]} {a[2]} -900 {c[0]} {c[1]} {c[2]}" for a, c in zip(xyz, rgb, strict=True)
    ]
    plain = [row.replace(" -900", "") for row in rows]
    commas = [row.replace(" ", ",") for row in plain]
    files = {
        "blocks.pts": ["100", *rows[:100], f"{NUM - 100}", *rows[100:]],
        "recap.pts": plain,
        "ends.csv": [row + "," for row in commas],
        "named.csv": ["\ufeffx [m],y [m],z [m],R,G,B,", *(row + "," for row in commas)],
        "marked.txt": ["\ufeff" + plain[0], *plain[1:]],
        "labelled.csv": ["Name,X,Y,Z,R,G,B", *(f"wall {i},{row}" for i, row in enumerate(commas))],
        "quoted.csv": ["x,y,z,r,g,b", *('"' + row.replace(",", '","') + '"' for row in commas)],
        "numbered.txt": [f"{i + 5}\t{row}" for i, row in enumerate(plain)],
        "a.xyzrgb": [row.replace(" -900", "") for row in rows],
    }
    for name, lines in files.items():
        (tmp_path / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
        check(tmp_path / name, xyz, rgb)


def test_files_of_other_programs_are_refused_by_name(tmp_path):
    for name, found in (("a.ptx", "CloudCompare"), ("a.rcp", "ReCap"), ("a.obj", "a mesh")):
        (tmp_path / name).write_bytes(b"1")
        with pytest.raises(SceneFormatError, match=found):
            open_cloud(tmp_path / name)


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
