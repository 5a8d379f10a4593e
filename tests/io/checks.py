"""What several tests of the formats read with, and check."""

from __future__ import annotations

import tracemalloc
from contextlib import contextmanager

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
from splatseed.io.rgbd import _read_intrinsics, _read_list, _read_track
from splatseed.io.scanner_app import _read_frame
from splatseed.io.stray import _read_camera as _read_stray_camera, _read_track as _read_odometry

CAMERAS = (Intrinsics(1, "PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0)),)


def read_images(path):
    return colmap.read_images(path, CAMERAS)


def read_capture_camera(path):
    return read_capture_scale(path), _read_intrinsics(path)


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
    "camera.json": _read_camera,
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
    target.write_bytes(data)
    with little_memory(limit):
        try:
            read(target)
        except SplatseedError as error:
            assert str(target) in str(error)  # noqa: PT017  (no error is as good as ours)


@st.composite
def damages(draw, data: bytes) -> bytes:
    """The bytes with a few overwritten, cut out, put in or repeated, also at their end."""
    damaged = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        # Headers are where it hurts, and tables at the end.
        at = draw(st.integers(0, min(len(damaged), draw(st.sampled_from([100, 400, 10**9])))))
        if draw(st.booleans()):
            at = len(damaged) - at
        width = draw(st.sampled_from([1, 2, 4, 8]))
        value = draw(st.integers(0, 2 ** (8 * width) - 1) | st.sampled_from([0, 1, 2**8 - 1]))
        patch = value.to_bytes(width, draw(st.sampled_from(["little", "big"])))
        patch = draw(st.sampled_from([patch, patch, b"", b"999999", bytes(damaged[at:])]))
        cut = draw(st.sampled_from([len(patch), len(patch), 0, width, len(damaged)]))
        damaged[at : at + cut] = patch
    return bytes(damaged)
