"""The readers of single depth maps, against the tools that write them."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image as PilImage

from splatseed import requirements
from splatseed.errors import MissingDependencyError, SceneFormatError, SceneNotFoundError
from splatseed.io.depth.arrays import read_colmap_depth, read_npy, read_npz, read_pfm
from splatseed.io.depth.pictures import read_exr, read_picture

SHAPES = hnp.array_shapes(min_dims=2, max_dims=2, max_side=9)
FLOATS = hnp.arrays(np.float32, SHAPES)
ANY = st.sampled_from([np.uint8, np.uint16, np.int32, np.float16, np.float64, ">f4"]).flatmap(
    lambda dtype: hnp.arrays(dtype, SHAPES)
)
repeat = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def assert_same(read, expected):
    np.testing.assert_array_equal(read, expected)
    assert read.shape == expected.shape


@repeat
@given(array=ANY, order=st.sampled_from("CF"))
def test_npy(tmp_path, array, order):
    np.save(tmp_path / "a.npy", np.asarray(array, order=order))
    assert_same(read_npy(tmp_path / "a.npy").values, array)


@repeat
@given(array=FLOATS, key=st.sampled_from(["depth", "arr_0", "z"]), packed=st.booleans())
def test_npz(tmp_path, array, key, packed):
    (np.savez_compressed if packed else np.savez)(tmp_path / "a.npz", **{key: array})
    assert_same(read_npz(tmp_path / "a.npz").values, array)


def test_npz_with_several_arrays_must_name_one(tmp_path):
    depth, other = np.ones((2, 3)), np.zeros((4, 5))
    np.savez(tmp_path / "a.npz", depth=depth, mask=other)
    assert_same(read_npz(tmp_path / "a.npz").values, depth)
    np.savez(tmp_path / "a.npz", disparity=depth, mask=other)
    with pytest.raises(SceneFormatError, match="one named depth; found disparity, mask"):
        read_npz(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", kind="ray")
    with pytest.raises(SceneFormatError, match="found none"):
        read_npz(tmp_path / "a.npz")


def test_npz_says_what_it_holds(tmp_path):
    np.savez(tmp_path / "a.npz", depth=np.ones((2, 3)), kind="inverse")
    assert read_npz(tmp_path / "a.npz").kind == "inverse"
    for wrong in ("metric", 3):
        np.savez(tmp_path / "a.npz", depth=np.ones((2, 3)), kind=wrong)
        with pytest.raises(SceneFormatError, match=rf"z, ray, inverse; found '{wrong}'"):
            read_npz(tmp_path / "a.npz")


@pytest.mark.parametrize("shape", [(1, 4, 5), (4, 5, 1)])
def test_axis_of_length_one_is_dropped(tmp_path, shape):
    np.save(tmp_path / "a.npy", np.arange(20.0).reshape(shape))
    assert_same(read_npy(tmp_path / "a.npy").values, np.arange(20.0).reshape(4, 5))


@pytest.mark.parametrize(
    "array",
    [
        np.ones(5),
        np.ones((2, 3, 3)),
        np.float32(1),
        np.ones((0, 3)),
        np.ones((3, 4), complex),
        np.ones((3, 4), bool),
        np.array([["a", "b"]]),
        np.array([[{}]], object),
        np.zeros((2, 2), [("x", "f4")]),
    ],
)
def test_arrays_that_are_no_map(tmp_path, array):
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    with pytest.raises(SceneFormatError, match=r"a\.npy to be a depth map"):
        read_npy(tmp_path / "a.npy")


def test_npy_header_that_promises_too_much_takes_no_memory(tmp_path, little_memory):
    stream = io.BytesIO()
    header = {"descr": "<f4", "fortran_order": False, "shape": (2**20, 2**20)}
    np.lib.format.write_array_header_1_0(stream, header)
    (tmp_path / "a.npy").write_bytes(stream.getvalue() + bytes(100))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.write(tmp_path / "a.npy", "depth.npy")
    for name, read in (("a.npy", read_npy), ("a.npz", read_npz)):
        with little_memory(), pytest.raises(SceneFormatError, match="found 100 bytes"):
            read(tmp_path / name)


def test_archive_that_would_fill_the_memory(tmp_path, little_memory):
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("depth.npy", b"")
    data = path.read_bytes()
    at = data.index(b"PK\x01\x02") + 24  # the uncompressed size in the central directory
    path.write_bytes(data[:at] + (2**32 - 2).to_bytes(4, "little") + data[at + 4 :])
    with little_memory(), pytest.raises(SceneFormatError, match="would become"):
        read_npz(path)


@repeat
@given(array=FLOATS, order=st.sampled_from("<>"), scale=st.sampled_from(["1", "1.000000", "2e-1"]))
def test_pfm(tmp_path, array, order, scale):
    sign = "-" if order == "<" else ""
    header = f"Pf\n{array.shape[1]} {array.shape[0]}\n{sign}{scale}\n".encode()
    body = array[::-1].astype(order + "f4").tobytes()
    (tmp_path / "a.pfm").write_bytes(header + body)
    assert_same(read_pfm(tmp_path / "a.pfm").values, array)


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"", "one-channel"),
        (b"PF\n2 1\n-1\n" + bytes(24), "one-channel"),
        (b"Pf\n2 1\n0\n" + bytes(8), "byte order"),
        (b"Pf\n2 1\n1e999\n" + bytes(8), "byte order"),
        (b"Pf\n2 1\n+-e\n" + bytes(8), "byte order"),
        (b"Pf\n0 1\n-1\n", "1x0"),
        (b"Pf\n2 1\n-1\n" + bytes(7), "8 bytes for 2 x 1 values; found 7"),
        (b"Pf\n2 1\n-1\n" + bytes(9), "8 bytes for 2 x 1 values; found 9"),
        (b"Pf\n999999999 999999999\n-1\n", "999999999x999999999"),
    ],
)
def test_bad_pfm(tmp_path, data, told):
    (tmp_path / "a.pfm").write_bytes(data)
    with pytest.raises(SceneFormatError, match=told):
        read_pfm(tmp_path / "a.pfm")


@repeat
@given(array=FLOATS)
def test_colmaps_own_depth_maps(tmp_path, array):
    pycolmap = pytest.importorskip("pycolmap")
    path = tmp_path / "a.jpg.geometric.bin"
    pycolmap.DepthMap.from_array(array, 0.0, 100.0).write(path)
    assert_same(read_colmap_depth(path).values, array)


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"", "W&H&1&"),
        (b"2&1&" + bytes(8), "W&H&1&"),
        (b"2&1&3&" + bytes(24), "W&H&1&"),  # a normal map
        (b"-2&1&1&" + bytes(8), "W&H&1&"),
        (b"0&1&1&", "1x0"),
        (b"2&1&1&" + bytes(4), "found 4"),
        (b"2&1&1&" + bytes(12), "found 12"),
        (b"100000&100000&1&" + bytes(12), "100000x100000"),
    ],
)
def test_bad_colmap_maps(tmp_path, data, told):
    (tmp_path / "a.bin").write_bytes(data)
    with pytest.raises(SceneFormatError, match=told):
        read_colmap_depth(tmp_path / "a.bin")


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
@repeat
@given(array=hnp.arrays(np.uint8, SHAPES) | hnp.arrays(np.uint16, SHAPES))
def test_integer_pictures(tmp_path, suffix, array):
    PilImage.fromarray(array).save(tmp_path / f"a{suffix}")
    assert_same(read_picture(tmp_path / f"a{suffix}").values, array)


@pytest.mark.parametrize("compression", [None, "tiff_lzw", "tiff_adobe_deflate"])
@repeat
@given(array=FLOATS | hnp.arrays(np.int32, SHAPES))
def test_wide_tiff(tmp_path, compression, array):
    PilImage.fromarray(array).save(tmp_path / "a.tif", compression=compression)
    assert_same(read_picture(tmp_path / "a.tif").values, array)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "LA", "P", "1", "CMYK"])
def test_colour_pictures_are_no_depth(tmp_path, mode):
    path = tmp_path / ("a.tiff" if mode == "CMYK" else "a.png")
    PilImage.new(mode, (4, 3)).save(path)
    with pytest.raises(SceneFormatError, match=f"one channel .* found a picture of mode {mode}"):
        read_picture(path)


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_damaged_pictures(tmp_path, rng, suffix):
    path = tmp_path / f"a{suffix}"
    PilImage.fromarray(rng.integers(0, 65536, (40, 30)).astype(np.uint16)).save(path)
    whole = path.read_bytes()
    for data in (b"", b"no picture", whole[: len(whole) // 2]):
        path.write_bytes(data)
        with pytest.raises(SceneFormatError, match="readable PNG or TIFF"):
            read_picture(path)


def write_exr(path: Path, channels: dict[str, np.ndarray], **header) -> None:
    openexr = pytest.importorskip("OpenEXR")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage, **header}
    openexr.File(header, channels).write(str(path))


@pytest.mark.parametrize("dtype", [np.float32, np.float16, np.uint32])
def test_exr(tmp_path, rng, dtype):
    array = (100 * rng.random((7, 5))).astype(dtype)
    write_exr(tmp_path / "a.exr", {"distance": array})
    assert_same(read_exr(tmp_path / "a.exr").values, array)


def test_exr_channels(tmp_path, rng):
    array, other = rng.random((2, 4, 5), np.float32)
    write_exr(tmp_path / "a.exr", {"R": other, "G": other, "B": other, "ViewLayer.Depth.Z": array})
    assert_same(read_exr(tmp_path / "a.exr").values, array)
    write_exr(tmp_path / "b.exr", {"normal.X": other, "normal.W": other})
    with pytest.raises(SceneFormatError, match=r"found normal\.W, normal\.X"):
        read_exr(tmp_path / "b.exr")


def test_cropped_exr(tmp_path):
    window = (np.array([0, 0], np.int32), np.array([9, 9], np.int32))
    write_exr(tmp_path / "a.exr", {"Z": np.ones((4, 5), np.float32)}, displayWindow=window)
    with pytest.raises(SceneFormatError, match="all of its picture"):
        read_exr(tmp_path / "a.exr")


def test_damaged_exr(tmp_path, rng):
    write_exr(tmp_path / "a.exr", {"Z": rng.random((40, 50), np.float32)})
    whole = (tmp_path / "a.exr").read_bytes()
    for data in (b"", b"no picture", whole[:100], whole[: len(whole) // 2]):
        (tmp_path / "a.exr").write_bytes(data)
        with pytest.raises(SceneFormatError, match=r"a\.exr to be a depth map with a readable"):
            read_exr(tmp_path / "a.exr")


def test_exr_without_its_package(tmp_path, monkeypatch):
    monkeypatch.setattr(requirements, "find_spec", lambda _: None)
    with pytest.raises(MissingDependencyError, match=r"pip install .*'OpenEXR>=3.3'"):
        read_exr(tmp_path / "a.exr")


@pytest.mark.parametrize(
    "read", [read_npy, read_npz, read_pfm, read_colmap_depth, read_picture, read_exr]
)
def test_missing_file(tmp_path, read):
    if read is read_exr:
        pytest.importorskip("OpenEXR")
    with pytest.raises(SceneNotFoundError, match="gone"):
        read(tmp_path / "gone")
    (tmp_path / "folder").mkdir()
    with pytest.raises(SceneFormatError, match="readable file"):
        read(tmp_path / "folder")
