"""The viewer in a browser, and of a run that trains: pages are driven, and looked at."""

from __future__ import annotations

import base64
import io
import shutil
import socket
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image

torch = pytest.importorskip("torch", reason="rendering needs PyTorch")
pytest.importorskip("viser", reason="the viewer needs viser (extra view)")

from splatseed.commands import view as verb
from splatseed.errors import ParameterError, SceneFormatError
from splatseed.io import load_scene
from splatseed.pointcloud import PointCloud
from splatseed.splat.evaluate import evaluate_views
from splatseed.splat.training_frame import TrainingFrame
from splatseed.training.prepare import prepare_run
from splatseed.training.settings import TrainSettings
from splatseed.viewer import pictures, session as session_module
from splatseed.viewer.models import ViewerItem, open_item, viewer_frame
from splatseed.viewer.page import GROUND
from splatseed.viewer.pictures import (
    Entry,
    canvas_view,
    clouds_by_origin,
    fitted_fov,
    viewer_pose,
    warp_to_canvas,
)
from splatseed.viewer.server import ENDED, TrainingViewer, Viewer, free_port

from ..bench import browser

needs_browser = pytest.mark.skipif(browser.CHROMIUM is None, reason="Chromium is not installed")

BLANK = 15  # a picture whose values deviate by less shows nothing


def _entry(item):
    return Entry(item, viewer_frame(item))


@contextmanager
def _served(*entries, **more):
    port = free_port("127.0.0.1", 0)
    viewer = Viewer(list(entries), "127.0.0.1", port, **more)
    viewer.url = f"http://127.0.0.1:{port}"
    yield viewer
    viewer.stop()


@pytest.fixture
def viewer(entry):
    """A run, served."""
    with _served(entry) as served:
        yield served


@pytest.fixture
def entry(run_folder):
    return _entry(open_item(run_folder))


FLAGS = (
    *(flag for flag in browser.FLAGS if flag != "--disable-gpu"),
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)


@contextmanager
def served_page(folder, url):
    """A page of a browser, with WebGL in software, at an address."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(browser, "FLAGS", FLAGS)
        with browser.chromium(folder) as page:
            page.open(url, 800, 600)
            yield page


def screenshot(page):
    """What the page shows, [H, W, 3]."""
    data = base64.b64decode(page.call("Page.captureScreenshot")["data"])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def waits_for(condition, seconds=30.0):
    """What comes true in time."""
    until = time.monotonic() + seconds
    while not (answer := condition()) and time.monotonic() < until:
        time.sleep(0.1)
    return answer


def text(page):
    return page.run("document.body.innerText")


def click_text(page, words, tag):
    """Click the last element that has just these words."""
    page.run(
        f"[...document.querySelectorAll({tag!r})]"
        f".filter(e => e.innerText === {words!r}).at(-1).click()"
    )


def toggle(page, label):
    """Click the checkbox of a label."""
    page.run(
        "(() => { let e = [...document.querySelectorAll('*')]"
        f".filter(e => e.innerText === {label!r}).at(-1);"
        " while (!e.querySelector('input[type=checkbox]')) e = e.parentElement;"
        " e.querySelector('input[type=checkbox]').click(); })()"
    )


def _session(viewer):
    assert waits_for(lambda: viewer.sessions, 90), "the page does not connect"
    return viewer.sessions[-1]


def _settled(session):
    """Wait for a full picture of what is shown."""
    canvas = session._client.camera
    full = (canvas.image_height, canvas.image_width)
    drawn = lambda: session._picture is not None and session._picture.shape[:2] == full
    return waits_for(drawn, 90)


# The page ----------------------------------------------------------------------------------------


@needs_browser
def test_a_run_is_seen_offline_and_a_flight_ends_at_its_camera(viewer, run_folder, tmp_path):
    with served_page(tmp_path, viewer.url) as page:
        session = _session(viewer)
        count = len(open_item(run_folder).scene.points)
        assert waits_for(lambda: f"original: {count:,}" in text(page)), text(page)
        assert _settled(session)
        # Not blank; the browser may still show the picture before, so it is waited for.
        assert waits_for(lambda: screenshot(page)[100:, :350].std() > BLANK)
        assert all(r.startswith((viewer.url, "data:", "blob:")) for r in page.requests)
        image, frustum = session._cameras[0]
        session._cameras_on.value = True
        frustum._impl.click_cb[0].callback(None)  # what viser calls at a click on it
        assert waits_for(lambda: session.at is image and not frustum.visible)  # not in its own way
        session._kind.value = "photograph"
        session.refresh()
        assert _settled(session)
        _, position = viewer_pose(image.camera, viewer.entries[0].frame)
        np.testing.assert_allclose(session._client.camera.position, position, atol=1e-4)
        assert session._note.content == ""
        page.drag(100, 400, 200)  # it leaves the camera's place, and with it the photograph
        assert waits_for(lambda: session.at is None and frustum.visible)
        assert waits_for(lambda: "Click a camera" in session._note.content)


@needs_browser
def test_switches_work_and_a_fast_browser_gets_more_points(entry, tmp_path, monkeypatch):
    monkeypatch.setattr(session_module, "POINTS", replace(session_module.POINTS, first=100))
    monkeypatch.setattr(session_module.Session, "_affordable_points", lambda _: 10**6)
    other, total = _entry(replace(entry.item, name="other")), len(entry.item.scene.points)
    with _served(entry, other, second=other) as viewer, served_page(tmp_path, viewer.url) as page:
        session = _session(viewer)
        assert (session._second.value, session._split.visible) == ("other: Gaussians", True)
        assert waits_for(lambda: f"original: {total:,}" in text(page))
        assert waits_for(lambda: len(session._clouds["original"].xyz) == total)
        before = session._cameras_on.value
        toggle(page, "Show cameras")
        assert waits_for(lambda: session._cameras_on.value != before)
        shots = []
        session._client.send_file_download = lambda name, data, **_: shots.append((name, data))
        click_text(page, "Screenshot", "button")
        assert waits_for(lambda: shots)
        assert shots[0][1].startswith(b"\x89PNG")
        monkeypatch.undo()
        monkeypatch.setattr(session_module, "POINTS", replace(session_module.POINTS, first=100))
        assert session._affordable_points() > 0
        # A browser that does not answer keeps its points, visible.
        monkeypatch.setattr(session_module, "POINTS", replace(session_module.POINTS, timeout=0.0))
        with pytest.raises(TimeoutError):
            session._affordable_points()
        session._points_on.value = True
        session._restyle()
        assert all(node.visible for node in session._nodes.values())


@needs_browser
def test_two_browsers_have_their_own_switches_and_may_disconnect(viewer, tmp_path):
    with served_page(tmp_path / "a", viewer.url) as first:
        one = _session(viewer)
        with served_page(tmp_path / "b", viewer.url):
            assert waits_for(lambda: len(viewer.sessions) == 2)
            two = viewer.sessions[-1]
            assert waits_for(lambda: two._nodes)
            two._kind.value = "depth"
            two._points_on.value = True
            two._restyle()
            assert one._kind.value == "Gaussians"
            assert not next(iter(one._nodes.values())).visible
        # The second was cut off; the first goes on.
        assert waits_for(lambda: len(viewer.sessions) == 1)
        assert waits_for(lambda: not two._loop._thread.is_alive())
        frames = one._loop.frames
        one.refresh()
        assert waits_for(lambda: one._loop.frames > frames)
        first.open(viewer.url, 800, 600)
        assert waits_for(lambda: viewer.sessions not in ([], [one]))


def test_requests_that_are_no_page_are_not_logged(viewer, caplog):
    """Browsers and port scanners make some, which are no fault of the user's."""
    port = int(viewer.url.rsplit(":", 1)[1])
    for words in (b"HEAD / HTTP/1.1\r\nHost: x\r\n\r\n", b"no request\r\n\r\n", b""):
        with socket.create_connection(("127.0.0.1", port)) as probe:
            probe.sendall(words)
            probe.shutdown(socket.SHUT_WR)
            while probe.recv(4096):
                pass
    assert [each.getMessage() for each in caplog.records if "websockets" in each.name] == []


# What is drawn -----------------------------------------------------------------------------------


def _canvas_at(entry, image, size):
    wxyz, position = viewer_pose(image.camera, entry.frame)
    fov = fitted_fov(image.camera, size[0] / size[1])
    return canvas_view(wxyz, position, fov, size, entry.frame)


def test_a_canvas_at_a_camera_is_that_camera(entry):
    image = entry.item.scene.images[3]
    canvas = _canvas_at(entry, image, (image.camera.width, image.camera.height))
    np.testing.assert_allclose(canvas.cam_from_world, image.camera.cam_from_world, atol=1e-9)
    np.testing.assert_allclose(canvas.K[1, 1], image.camera.K[1, 1])
    white = np.full((90, 120, 3), 255, np.uint8)  # of a wide one it fills the middle
    wide = warp_to_canvas(_canvas_at(entry, image, (400, 90)), white, image.camera, smooth=False)
    columns = np.flatnonzero(wide[45, :, 0])
    assert abs(len(columns) - 120) <= 2
    assert abs(columns.mean() - 199.5) <= 1


def test_each_picture_is_drawn_and_a_moving_one_keeps_the_most_visible(entry, monkeypatch):
    image = entry.item.scene.images[0]
    canvas = _canvas_at(entry, image, (160, 120))
    kinds = ("Gaussians", "depth", "photograph", "error", "points", "origins", "uncovered cells")
    assert entry.kinds == kinds
    drawn = {}
    for kind in kinds:
        drawn[kind], why = entry.draw(kind, canvas, image)
        assert (why, drawn[kind].shape) == ("", (120, 160, 3))
        if kind == "points":  # few, on a ground almost as grey
            assert (drawn[kind] != GROUND).any(axis=2).sum() > 50
        else:
            assert drawn[kind].std() > 3
    # What is drawn is what was photographed, as far as Gaussians nobody trained can be.
    photograph, full = drawn["photograph"].astype(int), drawn["Gaussians"].astype(int)
    assert np.abs(photograph - full).mean() < np.abs(photograph[:, ::-1] - full).mean()
    half = len(entry.item.gaussians) // 2
    monkeypatch.setattr(pictures, "MAX_MOVING", half)
    fast, _ = entry.draw("Gaussians", canvas, image, fast=True)
    assert entry.fast_renderer.count == half
    assert np.abs(full - fast).mean() < 0.6 * full.std()


def test_photographs_are_shown_as_models_are_rendered_without_distortion(room):
    scene = load_scene(room)
    lens = scene.images[0].intrinsics
    bent = replace(lens, model="OPENCV", params=(*lens.params, -0.4, 0.0, 0.0, 0.0))
    image = replace(scene.images[0], intrinsics=bent)
    entry = _entry(ViewerItem("room", scene.replace(images=(image, *scene.images[1:]))))
    canvas = _canvas_at(entry, image, (lens.width, lens.height))
    shown = entry.draw("photograph", canvas, image)[0].astype(int)
    with Image.open(room / "images" / image.name) as file:
        stored = np.asarray(file.convert("RGB")).astype(int)
    fx, fy, cx, cy = lens.params
    row, column = np.indices(stored.shape[:2])
    x, y = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
    factor = 1 - 0.4 * (x**2 + y**2)  # the lens pulls pixels inwards
    wanted = stored[(fy * factor * y + cy).astype(int), (fx * factor * x + cx).astype(int)]
    assert np.abs(shown - wanted).mean() < 0.5 * np.abs(stored - wanted).mean()


def test_a_picture_that_cannot_be_drawn_has_a_reason(room, run_folder, tmp_path):
    own = shutil.copytree(room, tmp_path / "own")
    entry = _entry(open_item(run_folder, own))
    image = entry.item.scene.images[0]
    canvas = _canvas_at(entry, image, (64, 48))
    for kind in ("photograph", "error", "uncovered cells"):
        picture, why = entry.draw(kind, canvas, None)
        assert (picture, why) == (None, pictures.CLICK_A_CAMERA)
    shutil.rmtree(own)
    picture, why = entry.draw("photograph", canvas, image)
    assert (picture, image.name in why) == (None, True)
    assert entry.draw("uncovered cells", canvas, image)[0] is not None


def test_points_are_split_by_origin(rng):
    source = np.repeat(np.array([0, 2, 9], np.uint8), 50)
    rgb = rng.integers(0, 255, (150, 3), dtype=np.uint8)
    cloud = PointCloud(rng.random((150, 3)), rgb, source)
    clouds = clouds_by_origin(cloud, TrainingFrame(np.zeros(3), 2.0), 1000)
    assert [each.count for each in clouds] == [50, 50, 50]
    assert len({each.color for each in clouds}) == 3
    np.testing.assert_allclose(clouds[0].xyz, 2 * cloud.xyz[:50], rtol=1e-6)


def test_sizes_follow_the_near_depth(room, run_folder):
    frame = viewer_frame(item := open_item(run_folder, room))
    # On a long walk, on which all that cameras see is a thousandth of their extent away.
    walk = replace(frame, near=frame.near / 1000)
    clouds = clouds_by_origin(item.scene.points, frame, 1000)
    before, after = (pictures.point_size(clouds, item.scene.images, f) for f in (frame, walk))
    assert after < 0.02 * before
    gui = Mock()
    for each in (frame, walk):
        pictures.add_cameras(gui, item, each, print)
    sizes = [call.kwargs["scale"] for call in gui.add_camera_frustum.call_args_list]
    assert sizes[-1] < 0.02 * sizes[0]


def test_of_many_cameras_as_many_are_test_views_as_of_all(room):
    scene = load_scene(room)
    images = tuple(replace(scene.images[0], name=f"{i:04}.png") for i in range(3000))
    item = ViewerItem("many", scene.replace(images=images))
    drawn = pictures.add_cameras(Mock(), item, viewer_frame(item), print)
    tested = {image.name for image in scene.replace(images=images).split()[1]}
    assert len(drawn) <= pictures.MAX_CAMERAS + 1
    assert sum(image.name in tested for image, _ in drawn) / len(drawn) == pytest.approx(
        0.125, 0.05
    )


def test_names_are_escaped():
    session = object.__new__(session_module.Session)
    session._note = Mock(content="")
    session._show_note("<img src=x onerror=alert(1)>.png cannot be read.")
    assert "&lt;img src=x" in session._note.content
    assert "<img" not in session._note.content


# A run that trains -------------------------------------------------------------------------------

STEPS = 40


@pytest.fixture
def watched(room, tmp_path):
    pytest.importorskip("gsplat", reason="training needs gsplat's strategies")
    scene = load_scene(room)
    settings = TrainSettings(max_steps=STEPS, data_factor=2, test_every=4, strategy="none")
    run = prepare_run(scene, tmp_path / "run", settings)
    viewer = TrainingViewer(run, scene, "room", "127.0.0.1", free_port("127.0.0.1", 0))
    viewer._sessions[0] = Mock()  # stands for a browser: without one, nothing is drawn
    yield run, viewer, scene
    viewer.close()


def test_renders_come_between_steps_and_change_nothing(watched, room, tmp_path):
    run, viewer, scene = watched
    canvas, pictures = _canvas_at(viewer.entries[0], scene.images[0], (80, 60)), []

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
    picture, why = viewer._live.draw("Gaussians", canvas, None)
    assert (picture, why) == (None, ENDED)
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
    waited = []

    def serve(wait=0.0):
        waited.extend([run.state.step] if wait else [])
        if len(waited) == 3:
            viewer.pause(on=False)

    def on_step(step):
        viewer.on_step(step)
        if step == 5:
            viewer.stop_and_keep()

    viewer._live.serve = serve
    assert not run.train(on_step)
    assert (waited, viewer.kept, run.state.step) == ([1, 1, 1], True, 6)
    assert run.finish(evaluate_views).steps == 6
    assert run.folder.gaussians.is_file()
    assert not run.folder.checkpoint.exists()


# The command -------------------------------------------------------------------------------------


def test_a_port_that_is_taken_is_an_error():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(ParameterError, match=str(taken.getsockname()[1])):
            free_port("127.0.0.1", taken.getsockname()[1])


def test_of_a_folder_with_many_items_the_first_are_shown_with_a_note(
    room, tmp_path, monkeypatch, capsys
):
    for name in "abc":
        (tmp_path / name).symlink_to(room)
    assert [path.name for path in verb._items_in(tmp_path)] == ["a", "b", "c"]
    monkeypatch.setattr(verb, "MAX_ITEMS", 2)
    assert [path.name for path in verb._items_in(tmp_path)] == ["a", "b"]
    printed = capsys.readouterr()
    assert str(tmp_path) in printed.out + printed.err


def test_runs_of_the_same_name_get_unique_names(run_folder, tmp_path):
    paths = [tmp_path / each / "fern" / "run" for each in "ab"]
    for path in paths:
        shutil.copytree(run_folder, path)
    items, second = verb._open_items(verb.Options(paths[0], compare=paths[1]))
    assert ([item.name for item in items], second) == (["a/fern/run", "b/fern/run"], 1)
    items, second = verb._open_items(verb.Options(paths[0].parent, compare=paths[0]))
    assert ([item.name for item in items], second) == (["run"], 0)


def test_a_web_page_is_for_a_browser(tmp_path, splatseed):
    page = tmp_path / "a page.HTML"
    page.write_text("<html>")
    run = splatseed("view", page)
    assert run.code == 2
    assert f"Open it in a browser: {page.as_uri()}" in run.err


def test_nothing_to_show_is_an_error(tmp_path):
    for name in ("cameras", "images", "points3D"):
        (tmp_path / f"{name}.txt").write_text("1 PINHOLE 4 3 2 2 2 1.5\n" * (name == "cameras"))
    with pytest.raises(SceneFormatError, match=str(tmp_path)):
        open_item(tmp_path)
