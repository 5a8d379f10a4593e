"""What is malformed, cut short or hostile is refused by name, early, whatever reads it."""

from __future__ import annotations

import io
import json
import struct
import zipfile

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.errors import SceneFormatError

from .checks import READERS, drain, little_memory
from .conftest import PCD


def saved(save, value, **options):
    file = io.BytesIO()
    save(file, value, **options)
    return file.getvalue()


def npy(array):
    return saved(np.save, array, allow_pickle=True)


def picture(mode, form):
    return saved(lambda file, image: image.save(file, form), PilImage.new(mode, (4, 3)))


def lying_npy():
    """What promises more than it has."""
    header = {"descr": "<f4", "fortran_order": False, "shape": (2**20, 2**20)}
    return saved(np.lib.format.write_array_header_1_0, header) + bytes(100)


def archive(data):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as opened:
        opened.writestr("depth.npy", data)
    return file.getvalue()


# COLMAP

CAMERA = struct.pack("<QIiQQ4d", 1, 1, 1, 640, 480, 500, 500, 320, 240)
IMAGE = struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.jpg\0" + struct.pack("<Q", 0)
POINT = struct.pack("<Q3d3BdQ2I", 1, 0, 0, 0, 1, 2, 3, 0.5, 1, 1, 0)  # without the file's count
TWO, MANY = struct.pack("<Q", 2), struct.pack("<Q", 2**60)


def patched(data, at, layout, value):
    """The bytes with one field changed."""
    return data[:at] + struct.pack(layout, value) + data[at + struct.calcsize(layout) :]


def points_of(*records):
    return struct.pack("<Q", len(records)) + b"".join(records)


def point(point_id=1, track_length=0):
    return struct.pack("<Q3d3BdQ", point_id, 0, 0, 0, 1, 2, 3, 0.5, track_length)


LINE = "1 1 0 0 0 0 0 0 1 a.jpg\n"

# PLY

HEAD = (
    "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
    "property float z\nend_header\n"
)
BYTES = "property uchar red\nproperty uchar green\nproperty uchar blue\nend_"
ASCII = HEAD.replace("binary_little_endian", "ascii").replace("vertex 1", "vertex 2") + "1 2 3\n"

# Captures

CAPTURE = {"w": 40, "h": 30, "fx": 35.0, "fy": 36.0, "cx": 19.5, "cy": 14.5, "scale": 1000.0}
WRONG_IN_CAPTURE = (
    *(("fx", "wide"), ("fx", 0), ("w", float("inf")), ("cx", float("nan"))),
    *(("scale", 0), ("fy", None)),
)

BAD = {
    "cameras.bin": [
        (b"", "byte 0"),
        (TWO + 2 * CAMERA[8:], "record 2"),
        (patched(CAMERA, 12, "<i", 99), "record 1"),
        (patched(CAMERA, 32, "<d", np.nan), "record 1"),
        (patched(CAMERA, 32, "<d", 0.0), "focal length above 0 .*record 1"),
    ],
    "images.bin": [
        (TWO + 2 * IMAGE[8:], "image id once .*record 2"),
        (TWO + IMAGE[8:] + patched(IMAGE, 8, "<I", 3)[8:], "name once .*record 2"),
        (patched(IMAGE, 12, "<d", np.nan), "record 1"),
        (patched(IMAGE, 12, "<d", 0.0), "quaternion .*record 1"),
        (patched(IMAGE, 68, "<I", 8), "camera id 8"),
        (IMAGE[:72] + b"no end" + 20 * b"x", "record 1"),
        (IMAGE[:72] + b"\0" + IMAGE[-8:], "an image name .*record 1"),
        (IMAGE[:-8] + MANY, "at most 0 features"),
        (IMAGE[:-8] + struct.pack("<QddQ", 1, 0, 0, 2**63), "record 1"),
    ],
    "points3D.bin": [
        (points_of(point(), POINT)[:-1], "record 2 of 2, byte 59; found 58"),
        (MANY + POINT, "at most 1 points"),
        *((points_of(point(track_length=2**n)), "record 1") for n in (60, 63)),
        (points_of(point(4), point(5), point(4)), "record 3; found 4"),
        (points_of(point(4), point(2**63)), "record 2"),
    ],
    "cameras.txt": [
        ("\n1 PINHOLE 640", "line 2; found '1 PINHOLE 640'"),
        ("1 LENS 640 480 1 2 3 4", "line 1; found 'LENS'"),
        ("1 PINHOLE 640 480 1 2 3", "line 1; found 3"),
        ("1 PINHOLE 640 480 1 2 3 nan", "line 1"),
        ("-1 PINHOLE 640 480 1 2 3 4", "line 1"),
        ("1 PINHOLE 6 4 1 2 3 4\n# c\n1 PINHOLE 6 4 1 2 3 4", "line 3"),
        (b"# one\n# caf\xe9\n", "line 2"),
    ],
    "images.txt": [
        ("# c\n1 1 0 0 0 0 0 0 1\n\n", "line 2"),
        ("1 1 0 0 0 0 0 0 5 a.jpg\n\n", "line 1; found camera id 5"),
        ("4294967296 1 0 0 0 0 0 0 1 a.jpg\n\n", "line 1"),
        (LINE + "1 2\n", "line 2; found '1 2'"),
        (LINE + "1 2 9223372036854775808\n", "line 2"),
        (LINE + "1 2 -2\n", "line 1"),
        (LINE + "\n1 1 0 0 0 0 0 0 1 b\n", "line 3; found 1"),
    ],
    "points3D.txt": [
        ("# c\n\n1 0 0 0 1 2 3", "line 3; found '1 0 0 0 1 2 3'"),
        ("1 0 0 0 1 2 3 .5\n2 0 x 0 1 2 3 .5", "line 2"),
        ("1 0 0 0 1 2 3 .5\n2 0 0 0 1 2 256 .5", "line 2"),
        ("1 0 0 0 1 2 3 .5 4 5\n2 0 0 0 1 2 3 .5 4 -1", "line 2"),
        ("1 0 0 0 1 2 3 .5\n9223372036854775808 0 0 0 1 2 3 .5", "line 2"),
        ("-1 0 0 0 1 2 3 .5", "line 1"),
        ("7 0 0 0 1 2 3 .5\n# c\n7 0 0 0 1 2 3 .5", "line 3; found 7"),
    ],
    "little.ply": [
        *("", "plyx\n" + HEAD[4:], HEAD[:-11], "ply\nend_header\n", HEAD.replace("1.0", "2.0")),
        HEAD.replace("_little_endian", ""),
        HEAD.replace("element vertex 1", ""),
        HEAD.replace("vertex 1", "vertex -1"),
        HEAD.replace("vertex 1", "vertex " + 5000 * "9"),
        *(HEAD.replace("float z", f"{other}") for other in ("real z", "float x", "float w")),
        *(HEAD.replace("float z", f"list {of} z") for of in ("uchar int", "int", "float int")),
        HEAD.replace("vertex", "point"),
        HEAD.replace("element vertex", "element chunk 1\nelement vertex"),
        HEAD.replace("end_header", "texture a.png\nend_header"),
        HEAD + 11 * "x",
        HEAD.replace("vertex 1", f"vertex {2**60}") + 24 * "x",
        HEAD.replace("end_header", "property uint packed_position\nend_header") + 99 * "x",
        *(ASCII + rest for rest in ("", "1 2\n", "1 2 x\n")),
        ASCII.replace("3\n", "3 4 5 300\n").replace("vertex 2", "vertex 1").replace("end_", BYTES),
    ],
    "a.pfm": [
        *(b"Pf\n" + rest for rest in (b"", b"0 1\n-1\n", b"999999999 999999999\n-1\n")),
        *(b"Pf\n2 1\n%s\n" % n + bytes(8) for n in (b"0", b"1e999", b"+-e")),
        b"PF\n2 1\n-1\n" + bytes(24),
    ],
    "a.bin": [
        b"2&1&" + bytes(8),
        b"2&1&3&" + bytes(24),  # a normal map
        *(b"", b"0&1&1&", b"100000&100000&1&" + bytes(12)),
    ],
    "a.png": [b"", *(picture(mode, "PNG") for mode in ("RGB", "RGBA", "LA", "P", "1"))],
    "a.tiff": [b"no picture", picture("CMYK", "TIFF")],
    "a.npy": [
        *(npy(np.ones(shape)) for shape in (5, (2, 3, 3), (), (0, 3))),
        *(npy(np.ones((3, 4), kind)) for kind in (complex, bool, str, [("x", "f4")])),
        npy(np.array([[{}]], object)),
        (lying_npy(), "values of float32 in"),
    ],
    "a.npz": [b"PK\x03\x04", (archive(lying_npy()), "values of float32 in")],
    "depths.json": [
        *(b"", b"\xff\xfe{}", b"[1]", b"[" * 100_000, b'{"kind": "metric"}', b'{"kind": ["z"]}'),
        *(b'{"scale": %s}' % n for n in (b"0", b"-2", b"NaN", b"1e999", b"true", b'"1"')),
        b'{"scale": 1' + b"0" * 400 + b"}",
    ],
    "cam_params.json": [
        *("", "[]", "{}", '{"camera": 3}'),
        *(json.dumps({"camera": CAPTURE | {key: value}}) for key, value in WRONG_IN_CAPTURE),
    ],
    "rgb.txt": [
        *("1.0 a.png b.png\n", "# x\n\nnow a.png\n", "nan a.png\n", "1.0\n"),
        *("1.0 ../a.png\n", "1.0 /a.png\n", b"\xff\xfe\x00"),
    ],
    "groundtruth.txt": [f"1 {rest}\n" for rest in ("2 3", "0 0 0 0 0 0 one", "0 0 0 0 0 0 2")],
    # Clouds
    "b.ply": [(HEAD.replace("vertex 1", "vertex 3") + 35 * "x", "truncated"), (ASCII, "found 1")],
    "a.e57": [b"no scan" * 1000],
    "a.xyz": [(12_000 * "1 2 3\n" + "1 two 3", "row 12,001 of .*'1 two 3'")],
    "a.txt": [b"", b"hello\nworld\n", b"1 2\n3 4\n"],
    "b.npz": [(saved(np.savez, np.zeros((3, 4))), "arr_0"), saved(np.savez, np.ones((3, 3)))[:100]],
    "a.glb": [b"", b"glTF", b"glTF\2\0\0\0" + bytes(60)],
    "a.pcd": [b"", (f"{PCD}binary\n", "truncated")],
    "a.jpg": [b""],
}


@pytest.mark.parametrize(
    ("name", "case"), [(name, i) for name, cases in BAD.items() for i in range(len(cases))]
)
def test_bad_files_are_named(tmp_path, name, case):
    if name == "a.e57":
        pytest.importorskip("pye57")
    data, said = BAD[name][case] if isinstance(BAD[name][case], tuple) else (BAD[name][case], "")
    path = tmp_path / name
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    read, limit = (READERS[name], 16 << 20) if name in READERS else (drain, 64 << 20)
    with little_memory(limit), pytest.raises(SceneFormatError, match=said or None) as caught:
        read(path)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
    assert path.exists()  # pye57 removes what it cannot open
