"""What several tests of the formats read with, and check."""

from __future__ import annotations

import tracemalloc
from contextlib import contextmanager
from pathlib import Path

from hypothesis import strategies as st

from splatseed.camera import Intrinsics
from splatseed.errors import SplatseedError
from splatseed.io import colmap
from splatseed.io.clouds import open_cloud
from splatseed.io.depth_files import read_confidence, read_stored
from splatseed.io.depth_maps import read_capture_scale, read_description
from splatseed.io.ply import read_ply
from splatseed.io.polycam import _read_camera
from splatseed.io.record3d import _read_metadata
from splatseed.io.rgbd import _read_list, _read_track, read_camera_file
from splatseed.io.scanner_app import _read_frame
from splatseed.io.stray import _read_camera as _read_stray_camera, _read_track as _read_odometry

CHARACTERS = st.characters(exclude_categories=["Cs"])
"""Those of ``st.text()``, which looks for what UTF-8 can encode: 2.4 s in every process."""
CAMERAS = (Intrinsics(1, "PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0)),)


def read_images(path):
    return colmap.read_images(path, CAMERAS)


def read_capture_camera(path):
    return read_capture_scale(path), read_camera_file(path)


def read_scanner_frame(path):
    return _read_frame(path, (96, 72))


def read_record3d(path):
    metadata = _read_metadata(path, path.read_bytes())
    return [metadata.frame(f"{number}.jpg") for number in range(len(metadata.poses))]


def read_odometry(path):
    track = _read_odometry(path.parent)
    return [track.frame(index, (96, 72)) for index in range(len(track.poses))]


READERS = {
    **dict.fromkeys(("cameras.bin", "cameras.txt"), colmap.read_cameras),
    **dict.fromkeys(("images.bin", "images.txt"), read_images),
    **dict.fromkeys(("points3D.bin", "points3D.txt"), colmap.read_points3d),
    **dict.fromkeys(("little.ply", "big.ply", "ascii.ply"), read_ply),
    **dict.fromkeys(("a.bin", "a.npy", "a.npz", "a.pfm", "a.png", "a.tiff"), read_stored),
    "conf_0.png": read_confidence,
    "frame_00000.json": read_scanner_frame,
    "camera.json": lambda path: _read_camera(path, path.with_name("a.png")),
    "metadata.json": read_record3d,
    "odometry.csv": read_odometry,
    "camera_matrix.csv": _read_stray_camera,
    "depths.json": read_description,
    "cam_params.json": read_capture_camera,
    "rgb.txt": _read_list,
    "groundtruth.txt": _read_track,
}
"""The reader of each small file."""


def drain(path):
    for chunk in open_cloud(path).chunks(50):
        assert 0 < len(chunk) <= 50


def rewrite(target: Path, data: bytes) -> Path:
    """The file with these bytes, made anew.

    ext4 waits for the disk when a file that was cut to nothing is closed: 5 ms for each write.
    """
    target.unlink(missing_ok=True)
    target.write_bytes(data)
    return target


@contextmanager
def little_memory(limit=16 << 20):
    """Fails if what runs in it allocates as a lying header would have it."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < limit
    finally:
        tracemalloc.stop()


def assert_only_our_errors(read, target, data, limit=16 << 20):
    """Whatever bytes a file has, it is read or one of our own errors names it."""
    rewrite(target, data)
    with little_memory(limit):
        try:
            read(target)
        except SplatseedError as error:
            assert str(target) in str(error)  # noqa: PT017  (no error is as good as ours)


def apply_edits(data: bytes, edits: list[tuple[int, ...]]) -> bytes:
    """The bytes with a few overwritten, cut out, put in or repeated, as ``EDITS`` drew it."""
    damaged = bytearray(data)
    for place, reach, from_end, width, number, order, kind, removed in edits:
        at = place % (min(len(damaged), reach) + 1)
        if from_end:
            at = len(damaged) - at
        value = (number % 2 ** (8 * width)).to_bytes(width, order)
        patch = (value, b"", b"999999", bytes(damaged[at:]))[kind]
        cut = (len(patch), 0, width, len(damaged))[removed]
        damaged[at : at + cut] = patch
    return bytes(damaged)


# Headers are where it hurts, and tables at the end. Strategies are made once: to make them anew for
# each edit, by what was drawn before, takes several times as long as to read what comes of it.
EDITS = st.lists(
    st.tuples(
        st.integers(0, 10**9), st.sampled_from([100, 400, 10**9]), st.booleans(),
        st.sampled_from([1, 2, 4, 8]), st.integers(0, 2**64 - 1) | st.sampled_from([0, 1, 255]),
        st.sampled_from(["little", "big"]),
        *[st.sampled_from([0, 0, 1, 2, 3])] * 2,
    ),
    min_size=1, max_size=4,
)  # fmt: skip
