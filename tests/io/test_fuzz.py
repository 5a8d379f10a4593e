"""Whatever bytes a reader is given, it returns a result or raises one of our own errors.

Readers of others can do worse than raise: lazrs ends the process when a table of chunks promises
more than memory holds, and laspy looks for as many records as a header promises.
"""

from __future__ import annotations

import json
import struct
from contextlib import suppress
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from PIL import Image as PilImage

from splatseed.errors import SceneFormatError, SplatseedError
from splatseed.io.depth_files import read_stored
from splatseed.io.ply import write_ply

from .checks import CHARACTERS, EDITS, READERS, apply_edits, assert_only_our_errors, drain, rewrite
from .conftest import CLOUDS, Model, written

TEXT = (".txt", ".csv", "ascii.ply")
WORDS = st.sampled_from(
    [*"0123456789", "-1", "255", "1e999", "nan", "-inf", "1_0", "0x1", "99999999999999999999", "#"]
    + ["\n"] * 6
    + ["\r\n", "\t", "\0", "\x1c", "\u2028", "\u0663", "PINHOLE", "OPENCV", "a b.jpg", '"']
)
HEADERS = st.sampled_from(
    [
        *(b"", b"4&3&1&", b"Pf\n4 3\n-1\n", b"\x93NUMPY\x01\x00", b"PK\x03\x04"),
        *(b"\x89PNG\r\n\x1a\n", b"II*\0", b'{"scale": ', b'{"camera": {"scale": '),
        b"1.5 0 0 0 0 0 0 ",
    ]
)
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:PIL")

fuzz = settings(
    max_examples=25,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)

MESH = """ply
format {form} 1.0
element vertex 2
property float x
property float y
property double z
property ushort red
property float green
property int blue
element face 1
property list uchar int vertex_indices
end_header
"""
ROW = np.dtype([("x", ">f4"), ("y", ">f4"), ("z", ">f8"), ("r", ">u2"), ("g", ">f4"), ("b", ">i4")])


@pytest.fixture(scope="module")
def valid(tmp_path_factory) -> dict[str, bytes]:
    """A small valid file of each kind; reading them also loads the compiled kernels."""
    folder = tmp_path_factory.mktemp("valid")
    image = "3 1 0 0 0 0 0 1 1 a b.jpg\n1.5 2 -1 3 4 9\n4 .5 .5 .5 .5 0 0 1 1 c.jpg\n\n"
    cameras = "1 PINHOLE 64 48 50 50 32 24\n8 OPENCV 6 4 1 2 3 4 5 6 7 8\n"
    (folder / "cameras.txt").write_text(cameras)
    (folder / "images.txt").write_text(image)
    (folder / "points3D.txt").write_text("9 1 2 3 4 5 6 .5 3 1\n12 1 nan 3 4 5 6 -1\n")
    names = ("cameras.txt", "images.txt", "points3D.txt")
    cameras, images, points = (READERS[name](folder / name) for name in names)
    written(folder, Model(cameras, images, *points))
    write_ply(folder / "little.ply", points[0])
    faces = b"\x03" + np.array([0, 1, 1], ">i4").tobytes()
    head = MESH.format(form="binary_big_endian").encode()
    body = np.array([(1, 2, 3, 200, 3, 4)] * 2, ROW).tobytes()
    (folder / "big.ply").write_bytes(head + body + faces)
    (folder / "ascii.ply").write_text(MESH.format(form="ascii") + "1 2 3 200 3 4\n" * 2 + "1 0\n")
    array = np.arange(1, 13, dtype=np.float32).reshape(3, 4)
    (folder / "a.bin").write_bytes(b"4&3&1&" + array.tobytes())
    (folder / "a.pfm").write_bytes(b"Pf\n4 3\n-1.0\n" + array.tobytes())
    np.save(folder / "a.npy", array)
    np.savez(folder / "a.npz", depth=array, kind="ray")
    PilImage.fromarray(array.astype(np.uint16)).save(folder / "a.png")
    PilImage.fromarray(array).save(folder / "a.tiff", compression="tiff_lzw")
    PilImage.fromarray(np.array([[0, 1, 2], [2, 2, 0]], np.uint8)).save(folder / "conf_0.png")
    K = [80, 0, 47.5, 0, 80, 35.5, 0, 0, 1]
    projection = [2 * 80 / 96, 0, 0, 0, 0, 2 * 80 / 72, *[0] * 9, 1]
    frame = {"cameraPoseARFrame": np.eye(4).ravel().tolist(), "intrinsics": K}
    frame = json.dumps({**frame, "projectionMatrix": projection})
    (folder / "frame_00000.json").write_text(frame)
    rows = {f"t_{i}{j}": float(i == j) for i in range(3) for j in range(4)}
    lens = {"fx": 80, "fy": 80, "cx": 48, "cy": 36, "width": 96, "height": 72}
    (folder / "camera.json").write_text(json.dumps({**rows, **lens}))
    metadata = {"w": 96, "h": 72, "dw": 48, "dh": 36, "K": [80, 0, 0, 0, 80, 0, 48, 36, 1]}
    metadata |= {
        "poses": [[0, 0, 0.6, 0.8, 1, 2, 3]],
        "perFrameIntrinsicCoeffs": [[80, 80, 48, 36]],
    }
    (folder / "metadata.json").write_text(json.dumps(metadata))
    header = "timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy\n"
    (folder / "odometry.csv").write_text(
        f"{header}0.5, 000000, 1, 2, 3, 0, 0, 0.6, 0.8, 8, 8, 4, 3\n"
    )
    (folder / "camera_matrix.csv").write_text("80.0, 0.0, 48\n0.0, 80.0, 36\n0.0, 0.0, 1.0")
    (folder / "depths.json").write_text('{"kind": "z", "scale": 2.5}')
    camera = '"w": 4, "h": 3, "fx": 5.5, "fy": 5, "cx": 2, "cy": 1.5, "scale": 2.5'
    (folder / "cam_params.json").write_text(f'{{"camera": {{{camera}}}}}')
    (folder / "rgb.txt").write_text("# time path\n1.5 rgb/a.png\n2.5 rgb/b.png\n")
    (folder / "groundtruth.txt").write_text("1.5 1 2 3 0 0 0 1\n2.5 1 2 3 0 0.6 0 0.8\n")
    for name, read in READERS.items():
        read(folder / name)
    return {name: (folder / name).read_bytes() for name in READERS}


@pytest.fixture(scope="module")
def clouds(cloud_files) -> dict[str, bytes]:
    """The same of clouds."""
    for name in CLOUDS:
        drain(cloud_files.folder / name)
    return {name: (cloud_files.folder / name).read_bytes() for name in CLOUDS}


@pytest.mark.parametrize("name", READERS)
@fuzz
@given(head=HEADERS, drawn=st.binary(max_size=300), edits=EDITS)
def test_damaged_files_and_random_bytes(name, target, head, drawn, edits, valid):
    whole = valid[name]
    for each in (head + drawn, whole[: len(drawn)] + drawn, apply_edits(whole, edits)):
        assert_only_our_errors(READERS[name], target.with_name(name), each)


@pytest.mark.parametrize("name", [name for name in READERS if name.endswith(TEXT)])
@settings(fuzz, max_examples=12)
@given(words=st.lists(WORDS | st.text(CHARACTERS, max_size=5), max_size=60))
def test_random_words(name, target, words, valid):
    whole, drawn = valid[name], " ".join(words).encode("utf-8", errors="replace")
    start = whole.find(b"end_header\n") + 11
    for each in (drawn, whole + drawn, whole[:start] + drawn):
        assert_only_our_errors(READERS[name], target.with_name(name), each)


@pytest.mark.parametrize("name", CLOUDS)
@fuzz
@given(edits=EDITS)
def test_damaged_clouds(name, target, edits, clouds):
    # Text is read in blocks of 16 MB.
    damaged = apply_edits(clouds[name], edits)
    assert_only_our_errors(drain, target.with_name(name), damaged, 64 << 20)


@pytest.mark.parametrize(
    "name", [name for name in READERS if name.endswith((".bin", ".pfm", ".npy", ".npz"))]
)
def test_every_other_length_is_refused(name, target, valid):
    target, size = target.with_name(name), len(valid[name])
    longer = () if name == "a.npz" else (size + 1, size + 100)  # an archive knows its end
    for length in (*range(size), *longer):
        rewrite(target, valid[name][:length].ljust(length, b"\0"))
        with pytest.raises(SplatseedError):
            READERS[name](target)


@pytest.mark.parametrize("name", ["a.png", "a.tiff"])
def test_every_shorter_picture_is_whole_or_refused(name, target, valid):
    """What is cut off may be a checksum or the mark of the end, never a value."""
    target = target.with_name(name)
    target.write_bytes(valid[name])
    whole = read_stored(target)
    for length in range(len(valid[name])):
        rewrite(target, valid[name][:length])
        with suppress(SplatseedError):
            np.testing.assert_array_equal(read_stored(target), whole)


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
def test_a_header_of_a_cloud_is_not_believed(name, lie, clouds, tmp_path):
    data = bytearray(clouds[name])
    lie(data)
    (tmp_path / name).write_bytes(data)
    with pytest.raises(SceneFormatError, match=name):
        drain(tmp_path / name)


def test_a_panic_of_lazrs_is_an_error_of_ours(cloud_files, monkeypatch):
    """pyo3 raises what is no Exception."""
    panic = type("PanicException", (BaseException,), {})("index out of bounds")
    monkeypatch.setattr("laspy.LasReader.read_points", Mock(side_effect=panic))
    with pytest.raises(SplatseedError, match="index out of bounds"):
        drain(cloud_files.folder / "a.laz")
