from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.ply.points import read_ply, write_ply
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
@pytest.mark.parametrize(
    ("kind", "values"), [("f4", (0, 0.5, 256)), ("f4", (-0.5, 0, 1)), ("i4", (0, -1, 5))]
)
def test_colours_out_of_range_are_refused(tmp_path, form, kind, values):
    fields = [*XYZ, *((name, kind) for name, _ in RGB)]
    with pytest.raises(SceneFormatError, match=r"colours from 0 to .*properties red, green, blue"):
        read_ply(_write(tmp_path, form, fields, [(0, 0, 0, *values)]))


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
@pytest.mark.parametrize("faces", [[(0, 1, 2), (1, 2, 3)], [(0, 1, 2), (0, 1, 2, 3)], [(), (1,)]])
@pytest.mark.parametrize("first", [True, False])
def test_elements_with_lists_may_stand_beside_the_vertices(tmp_path, form, faces, first):
    fields, path = (*XYZ, *RGB), tmp_path / "mesh.ply"
    parts = [
        (FACE, _faces(form, *faces)),
        (_vertex(fields, len(ROWS)), _body(form, fields, ROWS)),
    ]
    if form == "ascii" and () in faces:
        parts[0] = (FACE, b"0\n1 1\n")
    elements, bodies = zip(*parts if first else reversed(parts), strict=True)
    path.write_bytes(_header(form, *elements).encode() + b"".join(bodies))
    _assert_read(path)


@forms
def test_scalar_elements_may_come_first(tmp_path, form):
    camera = [("fx", "f8"), ("width", "i4")]
    fields, path = (*XYZ, *RGB), tmp_path / "points.ply"
    element = "element camera 1\nproperty double fx\nproperty int width\n"
    header = _header(form, element, "element nothing 5\n", _vertex(fields, len(ROWS)))
    bodies = _body(form, camera, [(500.5, 640)]) + _body(form, fields, ROWS)
    path.write_bytes(header.encode() + bodies)
    _assert_read(path)


def _with_vertex_lists(form, lengths):
    vertex = (
        _vertex(XYZ[:1], 2)
        + "property list uchar int seen_by\n"
        + "".join(f"property {KINDS[kind]} {name}\n" for name, kind in (*XYZ[1:], *RGB))
    )
    rows = (
        _body(form, XYZ[:1], [row[:1]])
        + _faces(form, range(length))
        + _body(form, (*XYZ[1:], *RGB), [row[1:]])
        for row, length in zip(ROWS, lengths, strict=True)
    )
    joined = b"".join(rows)
    if form == "ascii":  # a row is one line
        fields = iter(joined.split(b"\n"))
        joined = b"".join(b" ".join(itertools.islice(fields, 3)) + b"\n" for _ in ROWS)
    return _header(form, vertex).encode() + joined


@forms
def test_vertex_lists_of_one_length_are_passed_over(tmp_path, form):
    path = tmp_path / "points.ply"
    path.write_bytes(_with_vertex_lists(form, (2, 2)))
    _assert_read(path)


@forms
def test_vertex_lists_of_several_lengths_are_refused(tmp_path, form):
    path = tmp_path / "points.ply"
    path.write_bytes(_with_vertex_lists(form, (1, 2)))
    with pytest.raises(SceneFormatError, match="vertex lists of one length"):
        read_ply(path)


@pytest.mark.parametrize("length", ["", "x", "-1", "9" * 5000])
def test_list_lengths_that_are_none_are_refused(tmp_path, length):
    path = tmp_path / "points.ply"
    header = "element vertex 1\nproperty list char int seen_by\n" + _vertex(XYZ, 1).removeprefix(
        "element vertex 1\n"
    )
    path.write_text(_header("ascii", header) + f"{length}\n" * 2)
    with pytest.raises(SceneFormatError, match=r"the length of list seen_by|1 lines of vertices"):
        read_ply(path)
    path.write_bytes(_header("binary_little_endian", header).encode() + b"\xff" * 20)
    with pytest.raises(SceneFormatError, match="a list length of 0 or more"):
        read_ply(path)


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


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("", "to be a PLY file: .*found an empty file"),
        ("plyx\n" + POINT_HEADER[4:], "to be a PLY file"),
        (POINT_HEADER[:-11], "to be a PLY file"),
        ("ply\nend_header\n", r"format ascii.*line 2"),
        (POINT_HEADER.replace("1.0", "2.0"), r"line 2; found 'format binary_little_endian 2.0'"),
        (POINT_HEADER.replace("_little_endian", ""), "line 2"),
        (POINT_HEADER.replace("element vertex 1", ""), "an element before any property"),
        (POINT_HEADER.replace("vertex 1", "vertex -1"), r"line 4; found 'element vertex -1'"),
        (POINT_HEADER.replace("vertex 1", "vertex many"), "element NAME COUNT"),
        (POINT_HEADER.replace("float z", "real z"), "line 7; found 'property real z'"),
        (POINT_HEADER.replace("float z", "list float int z"), "line 7"),
        (POINT_HEADER.replace("float z", "float x"), "differ in name in .*line 4"),
        (POINT_HEADER.replace("float z", "float w"), "scalar x, y, z; found properties x, y, w"),
        (POINT_HEADER.replace("float z", "list uchar int z"), "scalar x, y, z"),
        (POINT_HEADER.replace("vertex", "point"), "found no element vertex"),
        (POINT_HEADER.replace("end_header", "texture a.png\nend_header"), "line 8"),
        (POINT_HEADER + 11 * "x", "4 more bytes in .*element vertex, byte [0-9]+; found 3"),
        (
            POINT_HEADER.replace("vertex 1", "vertex 2") + 23 * "x",
            "24 more bytes in .*element vertex, byte [0-9]+; found 23",
        ),
        (POINT_HEADER.replace("vertex 1", f"vertex {2**60}") + 24 * "x", "more bytes"),
        (POINT_HEADER.replace("vertex 1", "vertex " + 5000 * "9"), "element NAME COUNT"),
    ],
)
def test_malformed_files_name_the_place(tmp_path, little_memory, data, message):
    path = tmp_path / "points.ply"
    path.write_bytes(data.encode())
    with little_memory(), pytest.raises(SceneFormatError, match=message):
        read_ply(path)


@pytest.mark.parametrize(
    ("kinds", "body", "message"),
    [
        ("fff", "1 2 3\n", "2 lines of vertices in .*ascii body.*found 1"),
        ("fff", "1 2 3\n1 2\n", "a number for each vertex property .*row 2"),
        ("fff", "1 2 3\n1 2 x\n", "a number .*row 1"),
        ("ffi", "1 2 3\n1 2 3.5\n", "z as integers .*3.5 in row 2"),
    ],
)
def test_malformed_ascii_bodies_name_the_row(tmp_path, kinds, body, message):
    fields = [(name, {"f": "f4", "i": "i4"}[kind]) for name, kind in zip("xyz", kinds, strict=True)]
    path = tmp_path / "points.ply"
    path.write_text(_header("ascii", _vertex(fields, 2)) + body)
    with pytest.raises(SceneFormatError, match=message):
        read_ply(path)


def test_missing_files_are_our_errors(tmp_path):
    with pytest.raises(SceneNotFoundError):
        read_ply(tmp_path / "points.ply")
    with pytest.raises(SceneFormatError, match="readable"):
        read_ply(tmp_path)
