"""Single depth maps, against the tools that write them."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from numpy.lib import format as npy_format
from PIL import Image as PilImage

from splatseed import requirements
from splatseed.errors import MissingDependencyError, SceneFormatError
from splatseed.io.depth_files import read_stored

SHAPES = hnp.array_shapes(min_dims=2, max_dims=2, max_side=9)
FLOATS = hnp.arrays(np.float32, SHAPES)
ANY = st.sampled_from([np.uint8, np.uint16, np.int32, np.float16, np.float64, ">f4"]).flatmap(
    lambda dtype: hnp.arrays(dtype, SHAPES)
)
repeat = settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def assert_read(path, expected):
    values = read_stored(path)
    np.testing.assert_array_equal(values, expected)
    assert values.shape == expected.shape


@repeat
@given(array=ANY, order=st.sampled_from("CF"))
def test_npy(tmp_path, array, order):
    np.save(tmp_path / "a.npy", np.asarray(array, order=order))
    assert_read(tmp_path / "a.npy", array)
    for longer in (array[None], *([array[..., None]] if len(array) > 1 else [])):
        np.save(tmp_path / "a.npy", longer)
        assert_read(tmp_path / "a.npy", array)


@repeat
@given(array=FLOATS, key=st.sampled_from(["depth", "arr_0", "z"]), packed=st.booleans())
def test_npz(tmp_path, array, key, packed):
    (np.savez_compressed if packed else np.savez)(tmp_path / "a.npz", **{key: array})
    assert_read(tmp_path / "a.npz", array)


def test_npz_says_what_it_holds(tmp_path):
    depth, path = np.ones((2, 3)), tmp_path / "a.npz"
    np.savez(path, depth=depth, mask=np.zeros((4, 5)), camera="pinhole")
    assert_read(path, depth)
    for wrong in ({"disparity": depth, "mask": depth}, {"camera": "ray"}, {"a": depth, "b": 3}):
        np.savez(path, **wrong)
        with pytest.raises(SceneFormatError, match=r"a\.npz"):
            read_stored(path)


@repeat
@given(array=FLOATS, order=st.sampled_from("<>"), scale=st.sampled_from(["1", "1.000000", "2e-1"]))
def test_pfm(tmp_path, array, order, scale):
    sign = "-" if order == "<" else ""
    header = f"Pf\n{array.shape[1]} {array.shape[0]}\n{sign}{scale}\n".encode()
    (tmp_path / "a.pfm").write_bytes(header + array[::-1].astype(order + "f4").tobytes())
    assert_read(tmp_path / "a.pfm", array)


@repeat
@given(array=FLOATS)
def test_colmaps_own_depth_maps(tmp_path, array):
    pycolmap = pytest.importorskip("pycolmap")
    path = tmp_path / "a.jpg.geometric.bin"
    pycolmap.DepthMap.from_array(array, 0.0, 100.0).write(path)
    assert_read(path, array)


@repeat
@given(
    narrow=hnp.arrays(np.uint8, SHAPES) | hnp.arrays(np.uint16, SHAPES),
    wide=FLOATS | hnp.arrays(np.int32, SHAPES),
    compression=st.sampled_from([None, "tiff_lzw", "tiff_adobe_deflate"]),
)
def test_pictures(tmp_path, narrow, wide, compression):
    PilImage.fromarray(narrow).save(tmp_path / "a.png")
    assert_read(tmp_path / "a.png", narrow)
    for array in (narrow, wide):
        PilImage.fromarray(array).save(tmp_path / "a.tiff", compression=compression)
        assert_read(tmp_path / "a.tiff", array)


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(requirements, "find_spec", lambda _: None)
    (tmp_path / "a.exr").touch()
    with pytest.raises(MissingDependencyError, match=r"pip install .*'OpenEXR>=3.3'"):
        read_stored(tmp_path / "a.exr")


def write_exr(path, channels, **header):
    openexr = pytest.importorskip("OpenEXR")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage, **header}
    openexr.File(header, channels).write(str(path))


@pytest.mark.parametrize("dtype", [np.float32, np.float16, np.uint32])
def test_exr(tmp_path, rng, dtype):
    array, path = (100 * rng.random((7, 5))).astype(dtype), tmp_path / "a.exr"
    write_exr(path, {"distance": array})
    assert_read(path, array)
    other = rng.random((7, 5), np.float32)
    write_exr(path, {"R": other, "G": other, "B": other, "ViewLayer.Depth.Z": array})
    assert_read(path, array)
    window = (np.array([0, 0], np.int32), np.array([99, 99], np.int32))
    for channels, header, kept in (
        *(({"Z": array}, {}, kept) for kept in (0, 100, -20)),
        ({"Z": array}, {"displayWindow": window}, None),
        ({"normal.X": array, "normal.W": array}, {}, None),
    ):
        write_exr(path, channels, **header)
        path.write_bytes(path.read_bytes()[:kept])
        with pytest.raises(SceneFormatError, match=r"a\.exr to be a depth map"):
            read_stored(path)


def test_array_headers_are_parsed_in_one_thread_at_a_time(tmp_path, monkeypatch):
    """Two at once fail in CPython before 3.11.8, if rarely (python/cpython#106905)."""
    np.save(tmp_path / "a.npy", np.ones((3, 4), np.float32))
    parse, inside, most = npy_format.read_array_header_1_0, [], []

    def parse_slowly(file):
        inside.append(file)
        time.sleep(0.005)
        most.append(len(inside))
        inside.remove(file)
        return parse(file)

    monkeypatch.setattr(npy_format, "read_array_header_1_0", parse_slowly)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(read_stored, [tmp_path / "a.npy"] * 16))
    assert most == [1] * 16
