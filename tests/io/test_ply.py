from __future__ import annotations

import numpy as np
import pytest

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import load_scene
from splatseed.io.ply import read_ply, write_ply

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
