"""Whatever bytes a reader is given, it returns a result or raises one of our own errors."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from PIL import Image as PilImage

from splatseed.camera import Intrinsics
from splatseed.errors import SplatseedError
from splatseed.io import colmap
from splatseed.io.depth_files import read_stored
from splatseed.io.depth_maps import read_capture_scale, read_description
from splatseed.io.ply import read_ply, write_ply
from splatseed.io.rgbd import _read_list, _read_track

from .fuzzing import assert_only_our_errors

CAMERAS = (Intrinsics(7, "PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0)),)
READERS: dict[str, Callable[[Path], object]] = {
    "cameras.bin": colmap.read_cameras,
    "images.bin": lambda path: colmap.read_images(path, CAMERAS),
    "points3D.bin": colmap.read_points3d,
    "cameras.txt": colmap.read_cameras,
    "images.txt": lambda path: colmap.read_images(path, CAMERAS),
    "points3D.txt": colmap.read_points3d,
    "little.ply": read_ply,
    "big.ply": read_ply,
    "ascii.ply": read_ply,
    **dict.fromkeys(("a.bin", "a.npy", "a.npz", "a.pfm", "a.png", "a.tiff"), read_stored),
    "depths.json": read_description,
    "cam_params.json": read_capture_scale,
    "rgb.txt": _read_list,
    "groundtruth.txt": _read_track,
}
TEXT = [name for name in READERS if name.endswith((".txt", "ascii.ply"))]
HEADERS = st.sampled_from(
    [
        *(b"", b"4&3&1&", b"Pf\n4 3\n-1\n", b"\x93NUMPY\x01\x00", b"PK\x03\x04"),
        *(b"\x89PNG\r\n\x1a\n", b"II*\0", b'{"scale": ', b'{"camera": {"scale": '),
        b"1.5 0 0 0 0 0 0 ",
    ]
)
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:PIL")

fuzz = settings(
    max_examples=60,
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
    image = "3 1 0 0 0 0 0 1 7 a b.jpg\n1.5 2 -1 3 4 9\n4 .5 .5 .5 .5 0 0 1 7 c.jpg\n\n"
    (folder / "cameras.txt").write_text(
        "7 PINHOLE 64 48 50 50 32 24\n8 OPENCV 6 4 1 2 3 4 5 6 7 8\n"
    )
    (folder / "images.txt").write_text(image)
    (folder / "points3D.txt").write_text("9 1 2 3 4 5 6 .5 3 1\n12 1 nan 3 4 5 6 -1\n")
    points, tracks = colmap.read_points3d(folder / "points3D.txt")
    cameras = colmap.read_cameras(folder / "cameras.txt")
    images = colmap.read_images(folder / "images.txt", CAMERAS)
    colmap.write_cameras(folder / "cameras.bin", cameras)
    colmap.write_images(folder / "images.bin", images)
    colmap.write_points3d(folder / "points3D.bin", points, tracks)
    write_ply(folder / "little.ply", points)
    rows = [(1, 2, 3, 200, 3, 4)] * 2
    faces = b"\x03" + np.array([0, 1, 1], ">i4").tobytes()
    head = MESH.format(form="binary_big_endian").encode()
    (folder / "big.ply").write_bytes(head + np.array(rows, ROW).tobytes() + faces)
    (folder / "ascii.ply").write_text(MESH.format(form="ascii") + "1 2 3 200 3 4\n" * 2 + "1 0\n")
    array = np.arange(1, 13, dtype=np.float32).reshape(3, 4)
    (folder / "a.bin").write_bytes(b"4&3&1&" + array.tobytes())
    (folder / "a.pfm").write_bytes(b"Pf\n4 3\n-1.0\n" + array.tobytes())
    np.save(folder / "a.npy", array)
    np.savez(folder / "a.npz", depth=array, kind="ray")
    PilImage.fromarray(array.astype(np.uint16)).save(folder / "a.png")
    PilImage.fromarray(array).save(folder / "a.tiff", compression="tiff_lzw")
    (folder / "depths.json").write_text('{"kind": "z", "scale": 2.5}')
    (folder / "cam_params.json").write_text('{"camera": {"w": 4, "scale": 2.5}}')
    (folder / "rgb.txt").write_text("# time path\n1.5 rgb/a.png\n2.5 rgb/b.png\n")
    (folder / "groundtruth.txt").write_text("1.5 1 2 3 0 0 0 1\n2.5 1 2 3 0 0.6 0 0.8\n")
    for name, read in READERS.items():
        read(folder / name)
    return {name: (folder / name).read_bytes() for name in READERS}


@st.composite
def _damage(draw, data: bytes) -> bytes:
    """The bytes with a few overwritten, cut out, put in or repeated."""
    damaged = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(damaged)))
        width = draw(st.sampled_from([1, 2, 4, 8]))
        value = draw(st.integers(0, 2 ** (8 * width) - 1) | st.sampled_from([0, 1, 2**8 - 1]))
        patch = value.to_bytes(width, draw(st.sampled_from(["little", "big"])))
        match draw(st.sampled_from(["overwrite", "cut", "insert", "end", "repeat"])):
            case "overwrite":
                damaged[at : at + width] = patch
            case "cut":
                del damaged[at : at + width]
            case "insert":
                damaged[at:at] = patch
            case "end":
                del damaged[at:]
            case "repeat":
                damaged += damaged[at:]
    return bytes(damaged)


@pytest.mark.parametrize("name", READERS)
@fuzz
@given(data=st.binary(max_size=300), header=HEADERS)
def test_random_bytes(name, target, little_memory, data, header, valid):
    target = target.with_name(name)
    assert_only_our_errors(READERS[name], target, header + data, little_memory)
    assert_only_our_errors(READERS[name], target, valid[name][: len(data)] + data, little_memory)


@pytest.mark.parametrize("name", READERS)
@fuzz
@given(data=st.data())
def test_damaged_files(name, target, little_memory, data, valid):
    target = target.with_name(name)
    assert_only_our_errors(READERS[name], target, data.draw(_damage(valid[name])), little_memory)


WORDS = st.sampled_from(
    [*"0123456789", "-1", "255", "1e999", "nan", "-inf", "1_0", "0x1", "99999999999999999999", "#"]
    + ["\n"] * 6
    + ["\r\n", "\t", "\0", "\x1c", "\u2028", "\u0663", "PINHOLE", "OPENCV", "a b.jpg", '"']
)


@pytest.mark.parametrize("name", TEXT)
@fuzz
@given(words=st.lists(WORDS | st.text(max_size=5), max_size=60))
def test_random_words(name, target, little_memory, words, valid):
    target, text = target.with_name(name), " ".join(words).encode("utf-8", errors="replace")
    assert_only_our_errors(READERS[name], target, text, little_memory)
    assert_only_our_errors(READERS[name], target, valid[name] + text, little_memory)
    start = valid[name].find(b"end_header\n") + len(b"end_header\n")
    assert_only_our_errors(READERS[name], target, valid[name][:start] + text, little_memory)


@pytest.mark.parametrize(
    "name", [name for name in READERS if name.endswith((".bin", ".pfm", ".npy", ".npz"))]
)
def test_every_other_length_is_refused(name, target, valid):
    target, size = target.with_name(name), len(valid[name])
    longer = () if name == "a.npz" else (size + 1, size + 100)  # an archive knows its end
    for length in (*range(size), *longer):
        target.write_bytes(valid[name][:length].ljust(length, b"\0"))
        with pytest.raises(SplatseedError):
            READERS[name](target)


@pytest.mark.parametrize("name", ["a.png", "a.tiff"])
def test_every_shorter_picture_is_whole_or_refused(name, target, valid):
    """What is cut off may be a checksum or the mark of the end, never a value."""
    target = target.with_name(name)
    target.write_bytes(valid[name])
    whole = read_stored(target).values
    for length in range(len(valid[name])):
        target.write_bytes(valid[name][:length])
        with suppress(SplatseedError):
            np.testing.assert_array_equal(read_stored(target).values, whole)
