"""Whatever bytes a file has, its depth map is read or one of our own errors names it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from PIL import Image as PilImage

from splatseed.errors import SplatseedError
from splatseed.io.depth.arrays import read_colmap_depth, read_npy, read_npz, read_pfm
from splatseed.io.depth.folder import read_capture_scale, read_description
from splatseed.io.depth.pictures import read_picture
from splatseed.io.rgbd.tum_lists import read_list, read_track

from ..fuzzing import assert_only_our_errors

READERS: dict[str, Callable[[Path], object]] = {
    "a.bin": read_colmap_depth,
    "a.npy": read_npy,
    "a.npz": read_npz,
    "a.pfm": read_pfm,
    "a.png": read_picture,
    "a.tiff": read_picture,
    "depths.json": read_description,
    "cam_params.json": read_capture_scale,
    "rgb.txt": read_list,
    "groundtruth.txt": read_track,
}
fuzz = settings(
    max_examples=150,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
HEADERS = st.sampled_from(
    [
        *(b"4&3&1&", b"Pf\n4 3\n-1\n", b"Pf 4 3 1\n", b"\x93NUMPY\x01\x00", b"PK\x03\x04"),
        *(b"\x89PNG\r\n\x1a\n", b"II*\0", b'{"scale": ', b'{"camera": {"scale": '),
        b"1.5 0 0 0 0 0 0 ",
    ]
)
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:PIL")


@pytest.fixture(scope="module")
def valid(tmp_path_factory) -> dict[str, bytes]:
    """A small valid file of each kind."""
    folder = tmp_path_factory.mktemp("valid")
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


@pytest.mark.parametrize("name", READERS)
@fuzz
@given(data=st.binary(max_size=200), header=HEADERS | st.just(b""))
def test_random_bytes(name, target, little_memory, data, header):
    assert_only_our_errors(READERS[name], target, header + data, little_memory)


@pytest.mark.parametrize("name", READERS)
@fuzz
@given(data=st.data())
def test_damaged_files(name, target, little_memory, data, valid):
    damaged = bytearray(valid[name])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(damaged)))
        patch = data.draw(st.binary(max_size=4) | st.sampled_from([b"\xff\xff\xff\xff", b"999999"]))
        cut = data.draw(st.sampled_from([0, len(patch), len(patch), 2, len(damaged)]))
        damaged[at : at + cut] = patch
    assert_only_our_errors(READERS[name], target, bytes(damaged), little_memory)


@pytest.mark.parametrize("name", ["a.bin", "a.pfm", "a.npy", "a.npz"])
def test_every_other_length_is_refused(name, target, valid):
    size = len(valid[name])
    longer = () if name == "a.npz" else (size + 1, size + 100)  # an archive knows its end
    for length in (*range(size), *longer):
        target.write_bytes(valid[name][:length].ljust(length, b"\0"))
        with pytest.raises(SplatseedError):
            READERS[name](target)


@pytest.mark.parametrize("name", ["a.png", "a.tiff"])
def test_every_shorter_picture_is_whole_or_refused(name, target, valid):
    """What is cut off may be a checksum or the mark of the end, never a value."""
    target.write_bytes(valid[name])
    whole = read_picture(target).values
    for length in range(len(valid[name])):
        target.write_bytes(valid[name][:length])
        try:
            np.testing.assert_array_equal(read_picture(target).values, whole)
        except SplatseedError as error:
            assert str(target) in str(error)  # noqa: PT017  (no error is as good as ours)
