"""Photographs left out for their poses stay out of training, of scores and of resumed runs."""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest
from scipy.spatial.transform import Rotation

from splatseed import evaluate, train
from splatseed.camera import quat_from_rotation
from splatseed.checkup.wrong_poses import WRONG_POSES
from splatseed.io import load_scene, write_scene
from splatseed.training.prepare import prepare_run
from splatseed.training.request import PrepareOptions
from splatseed.training.settings import TrainSettings

QUICK = {"max_steps": 4, "data_factor": 2, "strategy": "none", "seeding": "scene"}


@pytest.fixture(scope="module")
def bent(larger_room_path, tmp_path_factory):
    """The room on disk, a training and a test photograph turned by 8 degrees, and their names."""
    room, wrong = load_scene(larger_room_path), (3, 8)
    images = sorted(room.images, key=lambda image: image.name)
    turn = Rotation.from_euler("y", 8, degrees=True).as_matrix()
    for i in wrong:
        pose = images[i].cam_from_world
        quat = quat_from_rotation(turn @ pose[:3, :3])
        images[i] = replace(images[i], quat=quat, translation=turn @ pose[:3, 3])
    path = tmp_path_factory.mktemp("bent") / "scene"
    write_scene(room.replace(images=tuple(images)), path)
    return path, [images[i].name for i in wrong]


def test_they_are_neither_trained_on_nor_tested(bent, tmp_path):
    path, wrong = bent
    before = [{im.name for im in part} for part in load_scene(path).split()]
    run = train(path, tmp_path / "run", drop_wrong_poses=True, **QUICK)
    assert run.config["dropped"] == wrong
    parts = [set(run.config["split"][part]) for part in ("train", "test")]
    assert parts == [part - {*wrong} for part in before]
    notes = []
    scores = evaluate(run, note=notes.append)
    assert {view.name for view in scores.per_image} == parts[1]
    assert scores.psnr == pytest.approx(run.metrics["psnr"], abs=1e-4)
    (said,) = notes
    assert (said.kind, said.severity, [*said.subjects]) == (WRONG_POSES, "info", wrong)
    file = shutil.copy(run.folder / "point_cloud.ply", tmp_path)  # of no run
    again = evaluate(file, path, data_factor=2)
    assert {view.name for view in again.per_image} == before[1]


def test_a_resumed_run_leaves_out_the_same(bent, tmp_path):
    path, wrong = bent
    settings = TrainSettings(**QUICK, drop_wrong_poses=True)
    prepare_run(load_scene(path), tmp_path / "run", settings)
    notes = []
    resume = PrepareOptions(resume=True)
    run = prepare_run(load_scene(path), tmp_path / "run", settings, resume, note=notes.append)
    assert not {view.name for view in run.trainer.train_views} & {*wrong}
    assert [note.subjects for note in notes if note.kind == WRONG_POSES] == [tuple(wrong)]
