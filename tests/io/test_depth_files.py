"""Single depth maps, against the tools that write them."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image as PilImage

from splatseed import requirements
from splatseed.errors import MissingDependencyError, SceneFormatError, SceneNotFoundError
from splatseed.io.depth_files import SUFFIXES, read_stored

from .checks import little_memory

SHAPES = hnp.array_shapes(min_dims=2, max_dims=2, max_side=9)
FLOATS = hnp.arrays(np.float32, SHAPES)
ANY = st.sampled_from([np.uint8, np.uint16, np.int32, np.float16, np.float64, ">f4"]).flatmap(
    lambda dtype: hnp.arrays(dtype, SHAPES)
)
repeat = settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def assert_read(path, expected):
    values = read_stored(path).values
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
    np.savez(path, depth=depth, mask=np.zeros((4, 5)), kind="inverse")
    assert_read(path, depth)
    assert read_stored(path).kind == "inverse"
    for wrong in ({"disparity": depth, "mask": depth}, {"kind": "ray"}, {"a": depth, "kind": 3}):
        np.savez(path, **wrong)
        with pytest.raises(SceneFormatError, match=r"a\.npz"):
            read_stored(path)


def test_npy_header_that_promises_too_much_takes_no_memory(tmp_path):
    stream = io.BytesIO()
    header = {"descr": "<f4", "fortran_order": False, "shape": (2**20, 2**20)}
    np.lib.format.write_array_header_1_0(stream, header)
    (tmp_path / "a.npy").write_bytes(stream.getvalue() + bytes(100))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.write(tmp_path / "a.npy", "depth.npy")
    for name in ("a.npy", "a.npz"):
        with little_memory(), pytest.raises(SceneFormatError, match="values of float32 in"):
            read_stored(tmp_path / name)


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


@pytest.mark.parametrize("compression", [None, "tiff_lzw", "tiff_adobe_deflate"])
@repeat
@given(data=st.data())
def test_pictures(tmp_path, compression, data):
    narrow = data.draw(hnp.arrays(np.uint8, SHAPES) | hnp.arrays(np.uint16, SHAPES))
    wide = data.draw(FLOATS | hnp.arrays(np.int32, SHAPES))
    PilImage.fromarray(narrow).save(tmp_path / "a.png")
    assert_read(tmp_path / "a.png", narrow)
    for array in (narrow, wide):
        PilImage.fromarray(array).save(tmp_path / "a.tiff", compression=compression)
        assert_read(tmp_path / "a.tiff", array)


@pytest.mark.parametrize(
    ("name", "data"),
    [
        *(("a.pfm", b"Pf\n" + rest) for rest in (b"", b"0 1\n-1\n", b"999999999 999999999\n-1\n")),
        *(("a.pfm", b"Pf\n2 1\n%s\n" % n + bytes(8)) for n in (b"0", b"1e999", b"+-e")),
        *(("a.pfm", b"Pf\n2 1\n-1\n" + bytes(size)) for size in (7, 9)),
        ("a.pfm", b"PF\n2 1\n-1\n" + bytes(24)),
        *(
            ("a.bin", b"2&1&%s" % rest)
            for rest in (b"" + bytes(8), b"1&" + bytes(4), b"1&" + bytes(12))
        ),
        ("a.bin", b"2&1&3&" + bytes(24)),  # a normal map
        *(("a.bin", data) for data in (b"", b"0&1&1&", b"100000&100000&1&" + bytes(12))),
        *(("a.png", b""), ("a.tiff", b"no picture"), ("a.npz", b"PK\x03\x04")),
        *(("a.png", PilImage.new(mode, (4, 3))) for mode in ("RGB", "RGBA", "LA", "P", "1")),
        ("a.tiff", PilImage.new("CMYK", (4, 3))),
        *(("a.npy", np.ones(shape)) for shape in (5, (2, 3, 3), (), (0, 3))),
        *(("a.npy", np.ones((3, 4), kind)) for kind in (complex, bool, str, [("x", "f4")])),
        ("a.npy", np.array([[{}]], object)),
    ],
)
def test_bad_files_are_named(tmp_path, name, data):
    if isinstance(data, bytes):
        (tmp_path / name).write_bytes(data)
    elif isinstance(data, PilImage.Image):
        data.save(tmp_path / name)
    else:
        np.save(tmp_path / name, data, allow_pickle=True)
    with pytest.raises(SceneFormatError, match=f"{name} to be a depth map"):
        read_stored(tmp_path / name)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_missing_files_and_packages(tmp_path, suffix, monkeypatch):
    with pytest.raises(SceneNotFoundError, match="gone"):
        read_stored(tmp_path / f"gone{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    with pytest.raises(SceneFormatError, match="readable file"):
        read_stored(tmp_path / f"folder{suffix}")
    if suffix == ".exr":
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
    array = (100 * rng.random((7, 5))).astype(dtype)
    write_exr(tmp_path / "a.exr", {"distance": array})
    assert_read(tmp_path / "a.exr", array)
    other = rng.random((7, 5), np.float32)
    write_exr(tmp_path / "a.exr", {"R": other, "G": other, "B": other, "ViewLayer.Depth.Z": array})
    assert_read(tmp_path / "a.exr", array)
    whole, path = (tmp_path / "a.exr").read_bytes(), tmp_path / "bad.exr"
    window = (np.array([0, 0], np.int32), np.array([99, 99], np.int32))
    for spoil in (b"", b"no picture", whole[:100], whole[: len(whole) // 2], "cropped", "channels"):
        if spoil == "cropped":
            write_exr(path, {"Z": array}, displayWindow=window)
        elif spoil == "channels":
            write_exr(path, {"normal.X": array, "normal.W": array})
        else:
            path.write_bytes(spoil)
        with pytest.raises(SceneFormatError, match=r"bad\.exr to be a depth map"):
            read_stored(path)
