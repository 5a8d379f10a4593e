"""Frames of a video: sharp, spread by movement, none from standing still."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io.files import is_video
from splatseed.sfm.photos import pick_frames
from splatseed.viewer.videos import write_video

HEIGHT, WIDTH = 120, 160
STILL = 12


@pytest.fixture(scope="module")
def wall():
    """A long textured wall to film along."""
    wall = gaussian_filter(np.random.default_rng(0).random((HEIGHT, 1200, 3)), (1.5, 1.5, 0))
    return (255 * (wall - wall.min()) / np.ptp(wall)).astype(np.uint8)


def test_frames_are_sharp_spread_and_not_of_standing_still(wall, tmp_path):
    """Of a film that stands still, then moves 4 px a frame; every third frame is blurred."""
    pytest.importorskip("imageio_ffmpeg", reason="videos need imageio-ffmpeg (extra sfm)")

    def frames():
        for i in range(60):
            at = 4 * max(0, i - STILL)
            frame = wall[:, at : at + WIDTH]
            yield gaussian_filter(frame, (3, 3, 0)) if i % 3 == 2 else frame

    video, folder = tmp_path / "walk.mp4", tmp_path / "frames"
    folder.mkdir()
    write_video(video, frames(), (WIDTH, HEIGHT), 30)
    picked = pick_frames(video, folder, 10)
    assert picked.total == 60
    assert picked.motion == pytest.approx(47 * 4 / 160, rel=0.15)  # 47 steps of 4 px of 160
    files = sorted(folder.iterdir())
    assert [f"walk_{number:06}.jpg" for number in picked.numbers] == [f.name for f in files]
    assert 8 <= len(files) <= 10
    assert Image.open(files[0]).size == (WIDTH, HEIGHT)
    assert not any(number % 3 == 2 for number in picked.numbers)  # those are blurred
    assert sum(number < STILL for number in picked.numbers) <= 1
    assert pick_frames(video, folder, 10) == picked


def test_what_cannot_be_used_is_told(wall, tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="videos need imageio-ffmpeg (extra sfm)")
    write_video(tmp_path / "still.mp4", [wall[:, :WIDTH]] * 20, (WIDTH, HEIGHT), 30)
    (tmp_path / "broken.mp4").write_bytes(b"\0" * 999)
    for name, most, error in (
        ("still.mp4", 10, SceneFormatError),
        ("broken.mp4", 10, SceneFormatError),
        ("none.mp4", 10, SceneNotFoundError),
        ("still.mp4", 1, ParameterError),
    ):
        with pytest.raises(error):
            pick_frames(tmp_path / name, tmp_path, most)
    assert is_video(tmp_path / "still.mp4")
    assert not is_video(tmp_path)
