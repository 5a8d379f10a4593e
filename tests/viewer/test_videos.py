"""Videos have the colours of their frames, and say how they are to be read."""

from __future__ import annotations

import gc
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="videos need imageio-ffmpeg (extra view)")

from splatseed.viewer.models import pinhole_view
from splatseed.viewer.videos import guessed_findings, unseen_findings, write_video

COLOURS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255], [90, 160, 40]])


@pytest.mark.parametrize(("suffix", "height"), [(".mp4", 48), (".mkv", 720), (".mov", 48)])
def test_players_show_the_colours_of_the_frames(tmp_path, suffix, height):
    picture = np.repeat(COLOURS, 32, axis=0).astype(np.uint8)[None].repeat(height, axis=0)
    video = tmp_path / f"video{suffix}"
    write_video(video, [picture] * 3, (160, height), 30.0)
    program = ffmpeg.get_ffmpeg_exe()
    facts = subprocess.run([program, "-i", video], capture_output=True, text=True, check=False)
    # ffmpeg names once what space, primaries and transfer have in common.
    assert "yuv420p(tv, bt709, progressive)" in facts.stderr
    as_tagged = "scale=in_color_matrix=bt709:in_range=tv"
    words = ["-v", "error", "-i", video, "-vf", as_tagged, "-frames:v", "1"]
    raw = subprocess.run(
        [program, *words, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"],
        capture_output=True,
        check=True,
    )
    shown = np.frombuffer(raw.stdout, np.uint8).reshape(height, 160, 3)
    np.testing.assert_allclose(shown[height // 2, 16::32], COLOURS, atol=4)  # BT.601: 24 off


def test_a_stopped_video_leaves_no_file_and_prints_nothing(tmp_path, capfd):
    def stopped():
        yield np.zeros((32, 48, 3), np.uint8)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        write_video(tmp_path / "a.mp4", stopped(), (48, 32), 30.0)
    del caught  # and with it the frames that keep ffmpeg's pipe open
    gc.collect()
    assert capfd.readouterr().err == ""
    assert not list(tmp_path.iterdir())


def test_frames_without_the_model_are_named():
    (found,) = unseen_findings([0.4, 0.0, 0.9, 0.001], ["a", "b", "c", "d"])
    assert (found.kind, found.subjects) == ("empty-frames", ("b", "d"))
    assert unseen_findings([0.4, 0.03], ["a", "b"]) == []


def _at(x, name):
    pose = np.eye(4)
    pose[0, 3] = -x
    return replace(pinhole_view((200, 200), np.pi / 2, pose), name=name)


def test_frames_that_leave_the_photographs_are_named():
    """Cameras of 90 degrees look at a wall 2 units ahead, of which they see 4 units each."""

    wall = SimpleNamespace(depth=lambda view: np.full((view.height, view.width), 2.0, np.float32))
    photographs = [_at(0.0, "a.jpg"), _at(1.0, "b.jpg")]
    between = [_at(x, f"{x}.png") for x in (0.0, 0.4, 1.0)]
    assert guessed_findings(wall, between, photographs) == []
    (found,) = guessed_findings(wall, [*between, _at(1.1, "c.png"), _at(3.0, "d.png")], photographs)
    assert (found.kind, found.subjects) == ("guessed-frames", ("d.png",))
    assert "1 of 5 frames" in found.text
    assert "50% (d.png)" in found.text  # of its 4 units 2 are seen from 1.0
    assert guessed_findings(wall, [_at(3.0, "d.png")], []) == []


def test_of_many_photographs_the_nearest_show_most_frames():
    rendered = []

    def depth(view):
        rendered.append(view.camera.center[0])
        return np.full((view.height, view.width), 2.0, np.float32)

    model = SimpleNamespace(depth=depth)
    photographs = [_at(0.5 * i, f"{i}.jpg") for i in np.random.default_rng(0).permutation(200)]
    assert guessed_findings(model, [_at(40.24, "a.png"), _at(60.0, "b.png")], photographs) == []
    assert sorted(rendered) == pytest.approx([40.0, 40.24, 40.5, 60.0, 60.0])
    (found,) = guessed_findings(model, [_at(101.5, "c.png")], photographs)
    assert "50% (c.png)" in found.text  # the last is at 99.5
    assert len(rendered) == 5 + 1 + 200  # each once
