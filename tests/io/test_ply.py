from __future__ import annotations

import numpy as np
import pytest

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import load_scene
from splatseed.io.ply import open_ply, read_ply, write_ply

KINDS = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "i4": "int"}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
XYZ = ("x", "f4"), ("y", "f4"), ("z", "f4")
RGB = ("red", "u1"), ("green", "u1"), ("blue", "u1")
FACE = "element face 2\nproperty list uchar int vertex_indices\n"

forms = pytest.mark.parametrize("form", ORDERS)


def _read(tmp_path, form, fields, rows, ends="\n", more="", after=b""):
    path = tmp_path / "points.ply"
    body = "".join(" ".join(map(str, row)) + ends for row in rows).encode()
    if form != "ascii":
        body = np.array(rows, [(name, ORDERS[form] + kind) for name, kind in fields]).tobytes()
    lines = [f"property {KINDS[kind]} {name}\n" for name, kind in fields]
    vertex = f"element vertex {len(rows)}\n{''.join(lines)}"
    header = f"ply\nformat {form} 1.0\ncomment made for a test\n{vertex}{more}end_header\n"
    path.write_bytes(header.replace("\n", ends).encode() + body + after)
    return read_ply(path)


@pytest.mark.parametrize("scene", ["bicycle", "stump"])
def test_real_clouds_are_written_back_byte_for_byte(scenes, scene, tmp_path):
    source = scenes / "mipnerf360_sfm" / scene / "sparse" / "0" / "points3D.ply"
    write_ply(tmp_path / "points.ply", read_ply(source))
    assert (tmp_path / "points.ply").read_bytes() == source.read_bytes()


@forms
@pytest.mark.parametrize(
    "names", ["red green blue", "r g b", "diffuse_{0} diffuse_{1} diffuse_{2}"]
)
@pytest.mark.parametrize("kind", ["f4", "f8", "i4"])
@pytest.mark.parametrize("order", [range(8), (5, 4, 3, 2, 1, 0, 6, 7), (6, 3, 0, 7, 4, 1, 5, 2)])
def test_every_form_order_and_name_gives_the_same_cloud(tmp_path, form, names, kind, order):
    colors = names.format("red", "green", "blue").split()
    fields = [*((axis, kind) for axis in "xyz"), *((name, "u1") for name in colors)]
    fields += [("confidence", "f4"), ("alpha", "u1")]
    rows = [(i, 2 * i, -i, 10 * i, 20, 255, 0.5, 255) for i in range(4)]
    shuffled = [tuple(row[i] for i in order) for row in rows]
    points = _read(tmp_path, form, [fields[i] for i in order], shuffled)
    np.testing.assert_array_equal(points.xyz, np.float32([row[:3] for row in rows]))
    np.testing.assert_array_equal(points.rgb, [row[3:6] for row in rows])


@forms
@pytest.mark.parametrize(
    ("kind", "values", "expected"),
    [
        ("f4", (0.0, 0.5, 1.0), (0, 128, 255)),
        ("f8", (0.0, 100.4, 255.0), (0, 100, 255)),
        ("f4", (0.25, float("nan"), 1.0), (64, 128, 255)),
        ("u2", (0, 257, 65535), (0, 1, 255)),
        ("i4", (0, 100, 255), (0, 100, 255)),
        ("i4", (0, 1, 1), (0, 1, 1)),
    ],
)
def test_colours_come_in_several_types(tmp_path, form, kind, values, expected):
    fields = [*XYZ, *((name, kind) for name, _ in RGB)]
    assert _read(tmp_path, form, fields, [(0, 0, 0, *values)]).rgb.tolist() == [list(expected)]


@forms
def test_missing_colours_are_mid_grey_and_those_of_gaussians_their_first_harmonic(tmp_path, form):
    assert len(_read(tmp_path, form, (*XYZ, *RGB), [])) == 0
    assert _read(tmp_path, form, XYZ, [(1, 2, 3)]).rgb.tolist() == [[128, 128, 128]]
    fields = [*XYZ, *((f"f_dc_{i}", "f4") for i in range(3)), ("opacity", "f4")]
    harmonic = (np.array([0.0, 0.2, 1.0]) - 0.5) * 2 * np.sqrt(np.pi)
    rows = [(0, 0, 0, *harmonic, 9), (1, 1, 1, -50, 0, 50, 9)]
    assert _read(tmp_path, form, fields, rows).rgb.tolist() == [[0, 51, 255], [0, 128, 255]]


@forms
def test_dos_line_ends_and_non_finite_positions_pass_and_faces_are_not_read(tmp_path, form):
    rows = [(float("nan"), float("inf"), 1e300, 1, 2, 3)]
    fields = [*((name, "f8") for name, _ in XYZ), *RGB]
    faces = b"3 0 1 2\n2 0 1\n" if form == "ascii" else bytes(22)
    points = _read(tmp_path, form, fields, rows, "\r\n", FACE, faces)
    np.testing.assert_array_equal(points.xyz, [[np.nan, np.inf, np.inf]])


LISTS = {
    "x": "f4", "views": "list uchar uint", "y": "f4", "weights": "list ushort float",
    "z": "f4", "red": "u1", "green": "u1", "blue": "u1", "more": "list int uchar",
}  # fmt: skip
ITEMS = {"views": ("u1", "u4"), "weights": ("u2", "f4"), "more": ("i4", "u1")}


def _with_lists(tmp_path, form, rng, before=""):
    """A PLY whose vertices have lists of 0 to 3 numbers anywhere, after four cameras."""
    header = [f"ply\nformat {form} 1.0\n{before}element vertex 50\n"]
    header += [f"property {KINDS.get(kind, kind)} {name}\n" for name, kind in LISTS.items()]
    xyz, rgb = rng.normal(size=(50, 3)).astype("f4"), rng.integers(0, 256, (50, 3), "u1")
    cameras = [(0, 1.5)] * 4 if before else []
    parts = [[np.array(a, ORDERS[form] + "u1"), np.array(b, ORDERS[form] + "f8")]
             for a, b in cameras]  # fmt: skip
    for i in range(50):
        given = dict(zip(("x", "y", "z", "red", "green", "blue"), [*xyz[i], *rgb[i]], strict=True))
        row = []
        for name, kind in LISTS.items():
            if name in given:
                row.append(np.array(given[name], ORDERS[form] + kind))
            else:
                values, (length, item) = rng.integers(0, 99, i % 4), ITEMS[name]
                row.append(np.array(len(values), ORDERS[form] + length))
                row.append(values.astype(ORDERS[form] + item))
        parts.append(row)
    if form == "ascii":
        lines = [" ".join(str(v) for each in row for v in each.ravel().tolist()) for row in parts]
        body = ("\n".join(lines) + "\n").encode()
    else:
        body = b"".join(each.tobytes() for row in parts for each in row)
    path = tmp_path / "lists.ply"
    path.write_bytes(("".join(header) + "end_header\n").encode() + body)
    return path, xyz, rgb


@forms
@pytest.mark.parametrize(
    "before", ["", "element camera 4\nproperty uchar id\nproperty double focal\n"]
)
def test_lists_among_properties_and_elements_before_vertices_are_skipped(
    tmp_path, form, before, rng, monkeypatch
):
    path, xyz, rgb = _with_lists(tmp_path, form, rng, before)
    monkeypatch.setattr("splatseed.io.ply._READ_BYTES", 100)
    chunks = list(open_ply(path).chunks(7))
    np.testing.assert_array_equal(np.concatenate([chunk.xyz for chunk in chunks]), xyz)
    points = read_ply(path)
    np.testing.assert_array_equal(points.xyz, xyz)
    np.testing.assert_array_equal(points.rgb, rgb)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(SceneFormatError, match=r"truncated|numbers in row"):
        read_ply(path)


def test_faces_before_vertices_are_refused_by_name(tmp_path):
    header = f"ply\nformat ascii 1.0\n{FACE}element vertex 1\n"
    lines = [*(f"property float {axis}\n" for axis in "xyz"), "end_header\n", "3 0 0 0\n"]
    (tmp_path / "mesh.ply").write_text(header + "".join(lines) + "3 0 0 0\n1 2 3\n")
    with pytest.raises(SceneFormatError, match="face before them"):
        read_ply(tmp_path / "mesh.ply")


@pytest.mark.parametrize("names", ["X Y Z Red Green Blue", "x y z scalar_red scalar_g b"])
def test_names_in_any_case_and_of_cloudcompare(tmp_path, names):
    kinds = ["f4"] * 3 + ["u1"] * 3
    points = _read(
        tmp_path, "ascii", list(zip(names.split(), kinds, strict=True)), [(1, 2, 3, 4, 5, 6)]
    )
    assert points.xyz.tolist() == [[1, 2, 3]]
    assert points.rgb.tolist() == [[4, 5, 6] if names[0] == "X" else [128, 128, 128]]


def test_missing_files_are_our_errors_and_so_are_models(tmp_path):
    with pytest.raises(SceneNotFoundError):
        read_ply(tmp_path / "points.ply")
    with pytest.raises(SceneFormatError, match="readable"):
        read_ply(tmp_path)
    for suffix in (".spz", ".splat", ".ksplat", ".sog", ".SPZ"):
        path = tmp_path / f"model{suffix}"
        path.write_bytes(b"\x1f\x8b")
        with pytest.raises(SceneFormatError, match=r"a trained model"):
            load_scene(path)
