from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import load_scene
from splatseed.io.ply import read_ply, write_ply
from splatseed.pointcloud import PointCloud

KINDS = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "i4": "int"}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
XYZ = ("x", "f4"), ("y", "f4"), ("z", "f4")
RGB = ("red", "u1"), ("green", "u1"), ("blue", "u1")
ROWS = [(1.5, -2, 3, 10, 20, 30), (4, 5, 6e-3, 40, 50, 255)]
FACE = "element face 2\nproperty list uchar int vertex_indices\n"

forms = pytest.mark.parametrize("form", ORDERS)


def _header(form, *elements):
    return f"ply\nformat {form} 1.0\ncomment made for a test\n{''.join(elements)}end_header\n"


def _vertex(fields, count):
    lines = (f"property {KINDS[kind]} {name}\n" for name, kind in fields)
    return f"element vertex {count}\n{''.join(lines)}"


def _body(form, fields, rows):
    if form == "ascii":
        return "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    return np.array(rows, [(name, ORDERS[form] + kind) for name, kind in fields]).tobytes()


def _write(tmp_path, form, fields, rows):
    path = tmp_path / "points.ply"
    path.write_bytes(_header(form, _vertex(fields, len(rows))).encode() + _body(form, fields, rows))
    return path


def _faces(form, *faces):
    if form == "ascii":
        return "".join(f"{len(f)} {' '.join(map(str, f))}\n" for f in faces).encode()
    order = ORDERS[form]
    return b"".join(bytes([len(f)]) + np.array(f, f"{order}i4").tobytes() for f in faces)


def _assert_read(path, rows=ROWS):
    points = read_ply(path)
    np.testing.assert_array_equal(points.xyz, np.float32([row[:3] for row in rows]))
    np.testing.assert_array_equal(points.rgb, [row[3:6] for row in rows])


@pytest.mark.parametrize("scene", ["bicycle", "stump"])
def test_real_clouds_are_written_back_byte_for_byte(scenes, scene, tmp_path):
    source = scenes / "mipnerf360_sfm" / scene / "sparse" / "0" / "points3D.ply"
    write_ply(tmp_path / "points.ply", read_ply(source))
    assert (tmp_path / "points.ply").read_bytes() == source.read_bytes()


@settings(max_examples=60, deadline=None)
@given(xyz=hnp.arrays(np.float32, st.tuples(st.integers(0, 6), st.just(3))), data=st.data())
def test_clouds_survive_a_round_trip(tmp_path_factory, xyz, data):
    path = tmp_path_factory.getbasetemp() / "round_trip.ply"
    points = PointCloud(xyz, data.draw(hnp.arrays(np.uint8, xyz.shape)))
    write_ply(path, points)
    read = read_ply(path)
    np.testing.assert_array_equal(read.xyz, points.xyz)
    np.testing.assert_array_equal(read.rgb, points.rgb)


def test_the_drop_in_form_holds_nothing_but_what_loaders_want(tmp_path):
    path = tmp_path / "points.ply"
    write_ply(path, PointCloud(np.ones((2, 3)), np.full((2, 3), 7, np.uint8)))
    header, body = path.read_bytes().split(b"end_header\n")
    assert header.decode().split("\n") == [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 2",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "",
    ]
    assert body == 2 * (np.float32([1, 1, 1, 0, 0, 0]).tobytes() + bytes([7, 7, 7]))


@forms
def test_every_form_gives_the_same_cloud(tmp_path, form):
    _assert_read(_write(tmp_path, form, (*XYZ, *RGB), ROWS))


@forms
@pytest.mark.parametrize("order", [(5, 4, 3, 2, 1, 0), (3, 0, 4, 1, 5, 2)])
def test_properties_may_come_in_any_order(tmp_path, form, order):
    fields = [(*XYZ, *RGB)[i] for i in order]
    rows = [tuple(row[i] for i in order) for row in ROWS]
    _assert_read(_write(tmp_path, form, fields, rows))


@forms
@pytest.mark.parametrize("kind", ["f8", "i4"])
def test_positions_may_have_any_number_type_and_neighbours(tmp_path, form, kind):
    fields = [("confidence", "f4"), *((name, kind) for name, _ in XYZ), *RGB, ("alpha", "u1")]
    rows = [(0.5, i, 2 * i, -i, 1, 2, 3, 255) for i in range(4)]
    _assert_read(_write(tmp_path, form, fields, rows), [row[1:7] for row in rows])


@forms
@pytest.mark.parametrize(
    "names", ["red green blue", "r g b", "diffuse_red diffuse_green diffuse_blue"]
)
def test_colours_go_by_several_names(tmp_path, form, names):
    fields = [*XYZ, *((name, "u1") for name in names.split())]
    _assert_read(_write(tmp_path, form, fields, ROWS))


@forms
@pytest.mark.parametrize(
    ("kind", "values", "expected"),
    [
        ("f4", (0.0, 0.5, 1.0), (0, 128, 255)),
        ("f8", (0.0, 100.4, 255.0), (0, 100, 255)),
        ("f4", (0.25, float("nan"), 1.0), (64, 128, 255)),
        ("u2", (0, 257, 65535), (0, 1, 255)),
        ("i4", (0, 100, 255), (0, 100, 255)),
    ],
)
def test_colours_come_in_several_types(tmp_path, form, kind, values, expected):
    fields = [*XYZ, *((name, kind) for name, _ in RGB)]
    assert read_ply(_write(tmp_path, form, fields, [(0, 0, 0, *values)])).rgb.tolist() == [
        list(expected)
    ]


@forms
def test_missing_colours_are_mid_grey(tmp_path, form):
    assert read_ply(_write(tmp_path, form, XYZ, [(1, 2, 3)])).rgb.tolist() == [[128, 128, 128]]


@forms
def test_trained_gaussians_give_the_colour_of_their_first_harmonic(tmp_path, form):
    fields = [*XYZ, *((f"f_dc_{i}", "f4") for i in range(3)), ("opacity", "f4")]
    colour = np.array([0.0, 0.2, 1.0])
    harmonic = (colour - 0.5) * 2 * np.sqrt(np.pi)
    rows = [(0, 0, 0, *harmonic, 9), (1, 1, 1, -50, 0, 50, 9)]
    rgb = read_ply(_write(tmp_path, form, fields, rows)).rgb
    assert rgb.tolist() == [[0, 51, 255], [0, 128, 255]]


@forms
def test_no_vertices_are_an_empty_cloud(tmp_path, form):
    assert len(read_ply(_write(tmp_path, form, (*XYZ, *RGB), []))) == 0


@forms
def test_dos_line_ends_and_non_finite_positions_pass(tmp_path, form):
    rows = [(float("nan"), float("inf"), 1e300, 1, 2, 3)]
    fields = [*((name, "f8") for name, _ in XYZ), *RGB]
    path = tmp_path / "points.ply"
    body = _body(form, fields, rows)
    if form == "ascii":
        body = body.replace(b"\n", b"\r\n")
    header = _header(form, _vertex(fields, 1)).replace("\n", "\r\n")
    path.write_bytes(header.encode() + body)
    np.testing.assert_array_equal(read_ply(path).xyz, [[np.nan, np.inf, np.inf]])


POINT_HEADER = _header("binary_little_endian", _vertex(XYZ, 1))


@forms
def test_faces_after_the_vertices_are_not_read(tmp_path, form):
    fields, path = (*XYZ, *RGB), tmp_path / "mesh.ply"
    header = _header(form, _vertex(fields, len(ROWS)), FACE)
    path.write_bytes(header.encode() + _body(form, fields, ROWS) + _faces(form, (0, 1, 2), (0, 1)))
    _assert_read(path)


@pytest.mark.parametrize(
    "data",
    [
        "",
        "plyx\n" + POINT_HEADER[4:],
        POINT_HEADER[:-11],
        "ply\nend_header\n",
        POINT_HEADER.replace("1.0", "2.0"),
        POINT_HEADER.replace("_little_endian", ""),
        POINT_HEADER.replace("element vertex 1", ""),
        POINT_HEADER.replace("vertex 1", "vertex -1"),
        POINT_HEADER.replace("vertex 1", "vertex " + 5000 * "9"),
        POINT_HEADER.replace("float z", "real z"),
        POINT_HEADER.replace("float z", "float x"),
        POINT_HEADER.replace("float z", "float w"),
        POINT_HEADER.replace("float z", "list uchar int z"),
        POINT_HEADER.replace("vertex", "point"),
        POINT_HEADER.replace("element vertex", "element chunk 1\nelement vertex"),
        POINT_HEADER.replace("end_header", "texture a.png\nend_header"),
        POINT_HEADER + 11 * "x",
        POINT_HEADER.replace("vertex 1", f"vertex {2**60}") + 24 * "x",
        POINT_HEADER.replace("end_header", "property uint packed_position\nend_header") + 99 * "x",
        _header("ascii", _vertex(XYZ, 2)) + "1 2 3\n",
        _header("ascii", _vertex(XYZ, 2)) + "1 2 3\n1 2\n",
        _header("ascii", _vertex(XYZ, 2)) + "1 2 3\n1 2 x\n",
    ],
)
def test_malformed_files_are_named(tmp_path, little_memory, data):
    path = tmp_path / "points.ply"
    path.write_bytes(data.encode())
    with little_memory(), pytest.raises(SceneFormatError, match=r"points\.ply"):
        read_ply(path)


def test_missing_files_are_our_errors(tmp_path):
    with pytest.raises(SceneNotFoundError):
        read_ply(tmp_path / "points.ply")
    with pytest.raises(SceneFormatError, match="readable"):
        read_ply(tmp_path)


@pytest.mark.parametrize("suffix", [".spz", ".splat", ".ksplat", ".sog", ".SPZ"])
def test_a_model_that_is_no_scene_is_named(suffix, tmp_path):
    path = tmp_path / f"model{suffix}"
    path.write_bytes(b"\x1f\x8b")
    with pytest.raises(SceneFormatError, match=r"a trained model"):
        load_scene(path)
