"""``train --view``: renders between steps, pause, stop and keep; the steps do not change."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")
pytest.importorskip("viser", reason="the viewer needs viser (extra view)")

from splatseed.io import load_scene
from splatseed.splat.evaluate import evaluate_views
from splatseed.train.run import prepare_run
from splatseed.train.settings import TrainSettings
from splatseed.view.pictures import canvas_view, fitted_fov, stage_pose
from splatseed.view.server import TrainingViewer, free_port

STEPS = 40


class _Onlooker:
    """Stands for a browser: without one, nothing is drawn."""

    def refresh(self):
        pass

    def close(self):
        pass


@pytest.fixture
def watched(room, tmp_path):
    scene = load_scene(room)
    settings = TrainSettings(max_steps=STEPS, data_factor=2, test_every=4, strategy="none")
    run = prepare_run(scene, tmp_path / "run", settings)
    viewer = TrainingViewer(run, scene, "room", "127.0.0.1", free_port("127.0.0.1", 0))
    viewer._sessions[0] = _Onlooker()
    yield run, viewer, scene
    viewer.close()


def _canvas(viewer, image):
    frame = viewer.entries[0].frame
    wxyz, position = stage_pose(image.camera, frame)
    return canvas_view(wxyz, position, fitted_fov(image.camera, 4 / 3), (80, 60), frame)


def test_renders_come_between_steps_and_change_nothing(watched, room, tmp_path):
    run, viewer, scene = watched
    canvas, pictures = _canvas(viewer, scene.images[0]), []

    def look():
        while len(pictures) < 5:
            pictures.append(viewer._live.draw("Gaussians", canvas, None))

    thread = threading.Thread(target=look)
    thread.start()
    assert run.train(viewer.on_step)
    viewer._live.close()
    thread.join(30)
    drawn = [picture for picture, _ in pictures if picture is not None]
    assert drawn
    assert all(picture.std() > 5 for picture in drawn)
    picture, why = viewer._live.draw("Gaussians", canvas, None)  # who looks after the end is told
    assert (picture, "ended" in why) == (None, True)
    numbers = viewer._numbers()
    for told in (f"step {STEPS}", f"{len(run.state.params['means']):,} Gaussians", "test views"):
        assert told in numbers
    alone = prepare_run(load_scene(room), tmp_path / "alone", run.settings)
    assert alone.train()
    for name, value in alone.state.params.items():
        np.testing.assert_array_equal(value.detach(), run.state.params[name].detach())


def test_a_pause_holds_and_a_stop_keeps(watched):
    run, viewer, _ = watched
    viewer.pause(on=True)
    seen = []

    def meddle():
        time.sleep(0.5)
        seen.append(run.state.step)
        time.sleep(0.5)
        seen.append(run.state.step)
        viewer.pause(on=False)
        time.sleep(0.2)
        viewer.stop_and_keep()

    thread = threading.Thread(target=meddle)
    thread.start()
    slow = viewer.on_step

    def on_step(step):
        time.sleep(0.02)
        slow(step)

    assert not run.train(on_step)
    thread.join()
    assert seen[0] == seen[1] == 1
    assert viewer.kept
    assert 1 < run.state.step < STEPS
    assert run.finish(evaluate_views).steps == run.state.step
    assert run.folder.gaussians.is_file()
    assert not run.folder.checkpoint.exists()
