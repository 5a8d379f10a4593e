"""``splatseed flight`` as a user runs it: readable videos, and one line for what is refused."""

from __future__ import annotations

import dataclasses
import gc
import json
import shutil

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="rendering needs PyTorch")
ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="videos need imageio-ffmpeg (extra view)")

from splatseed.io import load_scene, write_scene
from splatseed.similarity import Similarity
from splatseed.splat.ply import read_gaussians
from splatseed.viewer.renderer import ModelRenderer, model_frame
from splatseed.viewer.video import write_video
from splatseed.views.view import poses_of


def _frames(path):
    """A video's frames, [F, H, W, 3], and its frames per second."""
    reader = ffmpeg.read_frames(str(path))
    facts = next(reader)
    width, height = facts["size"]
    frames = [np.frombuffer(each, np.uint8).reshape(height, width, 3) for each in reader]
    return np.stack(frames), facts["fps"]


def test_a_flight_is_a_video_of_the_scene(run_folder, tmp_path, splatseed):
    out = tmp_path / "deep/flight.mp4"
    said = splatseed("flight", run_folder, "-o", out, "--seconds", 0.5, "--fps", 12)
    assert (said.code, said.err) == (0, "")
    frames, fps = _frames(out)
    assert (frames.shape, fps) == ((6, 90, 120, 3), 12)
    assert frames.mean() > 20
    assert np.abs(np.diff(frames.astype(int), axis=0)).mean() > 0.5  # it moves


def test_two_models_are_split_and_odd_sizes_become_even(run_folder, tmp_path, splatseed):
    out = tmp_path / "flight.mp4"
    words = ("--orbit", "--seconds", 0.3, "--fps", 10, "--size", "101x75")
    ply = run_folder / "point_cloud.ply"
    said = splatseed("flight", run_folder, "-o", out, "--compare", ply, *words)
    assert said.code == 0, said.err
    frames, _ = _frames(out)
    assert frames.shape == (3, 76, 100, 3)
    assert (frames[:, 10:60, 49:51].mean(axis=(0, 2, 3)) > 150).all()  # the line between them


def test_without_cameras_the_video_circles_and_says_so(run_folder, tmp_path, splatseed):
    ply = tmp_path / "model.ply"
    ply.write_bytes((run_folder / "point_cloud.ply").read_bytes())
    words = ("flight", ply, "--seconds", 0.1, "--fps", 20, "--size", "48x32", "-o")
    said = splatseed(*words, tmp_path / "a.mp4")
    assert said.code == 0, said.err
    assert "so the video circles; --scene SCENE" in said.out
    asked = splatseed(*words, tmp_path / "b.mp4", "--orbit")
    assert "circles" not in asked.out
    assert (_frames(tmp_path / "a.mp4")[0] == _frames(tmp_path / "b.mp4")[0]).all()


def test_a_path_of_nerfstudios_is_followed_in_depth(run_folder, tmp_path, splatseed):
    frame = {"camera_to_world": np.eye(4).reshape(-1).tolist(), "fov": 60}
    (tmp_path / "p.json").write_text(json.dumps({"camera_path": 4 * [frame], "fps": 8}))
    out = tmp_path / "flight.mkv"
    said = splatseed(
        "flight",
        run_folder,
        "-o",
        out,
        "--path",
        tmp_path / "p.json",
        "--transform",
        "none",
        "--depth",
    )
    assert said.code == 0, said.err
    frames, fps = _frames(out)
    assert (len(frames), fps) == (4, 8)


def test_a_path_through_nerfstudios_world_needs_its_transform(
    room, run_folder, tmp_path, splatseed
):
    """Turned, moved and scaled: as it is, it leads past the model; with the transform it does
    not."""
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    world = Similarity(0.01, turn, np.array([0.2, 40.0, 0.1]))
    content = {
        "transform": np.column_stack([turn, world.translation / 0.01]).tolist(),
        "scale": 0.01,
    }
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(content))
    camera = load_scene(room).images[3].camera
    pose = np.linalg.inv(world.camera(camera.cam_from_world)) @ np.diag([1.0, -1, -1, 1])
    fov = np.degrees(2 * np.arctan(camera.height / 2 / camera.K[1, 1]))
    frames = 2 * [{"camera_to_world": pose.reshape(-1).tolist(), "fov": fov}]
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"camera_path": frames, "fps": 8}))
    words = ("flight", run_folder, "-o", tmp_path / "flight.mp4", "--path", path)
    said = splatseed(*words)
    assert said.code == 2
    assert "--transform" in said.err
    said = splatseed(*words, "--transform", tmp_path / "dataparser_transforms.json")
    assert said.code == 0, said.err
    gaussians = read_gaussians(run_folder / "point_cloud.ply")
    wanted = ModelRenderer(gaussians, model_frame(gaussians, None)).color(
        poses_of([load_scene(room).images[3]])[0]
    )
    shown = _frames(tmp_path / "flight.mp4")[0][0] / 255
    assert np.abs(shown - wanted).mean() < 0.03


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("-o", "a.avi"), ".mp4"),
        (("-o", "a.mp4", "--size", "0x9"), "--size"),
        (("-o", "a.mp4", "--fps", "0"), "--fps"),
        (("-o", "a.mp4", "--orbit", "--path", "p.json"), "both"),
        (("-o", "a.mp4", "--path", "none.json"), "none.json"),
        (("-o", "a.mp4", "--transform", "gsplat"), "--path"),
        (("-o", "a.mp4", "--compare", "nowhere"), "nowhere"),
        (("-o", "a.mp4", "--crop=5,5,5,1,1,1"), "--crop"),
        (("-o", "x" * 300 + ".mp4", "--seconds", "0.1"), "name too long"),
    ],
)
def test_bad_input_is_one_line(words, said, run_folder, tmp_path, monkeypatch, splatseed):
    monkeypatch.chdir(tmp_path)
    heard = splatseed("flight", run_folder, *words)
    assert heard.code == 2
    assert said in heard.err
    assert heard.err.count("\n") == 1
    assert not list(tmp_path.glob("*.mp4"))


def test_a_stopped_video_leaves_nothing_and_ffmpeg_says_nothing(tmp_path, capfd):
    def stopped():
        yield np.zeros((32, 48, 3), np.uint8)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        write_video(tmp_path / "a.mp4", stopped(), (48, 32), 30.0)
    del caught  # and with it the frames that keep ffmpeg's pipe open
    gc.collect()
    assert capfd.readouterr().err == ""
    assert not list(tmp_path.iterdir())


def test_models_of_two_places_are_not_compared(run_folder, room, tmp_path, splatseed):
    scene = load_scene(room)
    moved = [dataclasses.replace(im, translation=im.translation + 1) for im in scene.images]
    write_scene(scene.replace(images=tuple(moved)), tmp_path / "elsewhere")
    other = shutil.copytree(run_folder, tmp_path / "other")
    config = json.loads((other / "config.json").read_text())
    config["scene"] = str(tmp_path / "elsewhere")
    (other / "config.json").write_text(json.dumps(config))
    words = ("flight", run_folder, "--compare", other, "--seconds", 0.1, "--fps", 20)
    heard = splatseed(*words, "-o", tmp_path / "a.mp4")
    assert (heard.code, heard.err.count("\n")) == (2, 1)
    assert "a model of the same scene as" in heard.err
    heard = splatseed(*words, "-o", tmp_path / "a.mp4", "--scene", room)
    assert heard.code == 0, heard.err


def test_a_scene_is_no_model(room, tmp_path, splatseed):
    heard = splatseed("flight", room, "-o", tmp_path / "a.mp4")
    assert heard.code == 2
    assert "found a scene. Train it first" in heard.err
