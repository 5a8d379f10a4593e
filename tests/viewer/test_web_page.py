"""A page of a run: the model is inside, nothing else is asked for, and a browser draws it."""

from __future__ import annotations

import base64
import dataclasses
import gzip
import json
import re

import numpy as np
import pytest
from scipy.spatial import cKDTree

from splatseed.commands import export
from splatseed.errors import OutputError
from splatseed.photos.upright import up_direction
from splatseed.scene import BLACK
from splatseed.splat.formats import read_gaussians, write_gaussians
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.training_frame import TrainingFrame
from splatseed.viewer import web_page
from splatseed.viewer.models import open_item, pinhole_view, viewer_frame
from splatseed.viewer.web_page import check_page_size, write_page

from ..bench import browser
from .test_viewer import screenshot, served_page, waits_for

FLIP = np.diag([-1.0, -1.0, 1.0])
"""From the axes of a file to those of the viewer, as its API reference has it."""
NAVY = (10, 20, 60)


@pytest.fixture(scope="module")
def page(run_folder, tmp_path_factory):
    """The page of a run, whose colours depend on the view."""
    rng, path = np.random.default_rng(0), tmp_path_factory.mktemp("page") / "a <b> & c.html"
    item = open_item(run_folder)
    # In one direction, so that the palette of an .sog loses little.
    strength = rng.uniform(-1, 1, (len(item.model), 1, 1))
    shN = (strength * rng.normal(0, 0.1, (15, 3))).astype(np.float32)
    # Of large ones, pictures depend on where a viewer cuts a Gaussian off.
    model = dataclasses.replace(item.model, scales=item.model.scales - np.float32(0.5), shN=shN)
    item = dataclasses.replace(item, name="a <b> & c", gaussians=model, background=NAVY)
    return path, item, write_page(path, item)


def parts_of(path):
    """The options of the viewer in a page, and the bytes inside by their names."""
    text = path.read_text("utf-8")
    options = json.loads(re.search(r"createViewer\(\{.*?\.\.\.(\{.*\}) \}\)", text)[1])
    inside = re.findall(r'<script type="text/plain" id="(\w+)">([^<]*)</script>', text)
    return options, {name: base64.b64decode(data) for name, data in inside}


def model_of(path, folder):
    file = folder / "model.sog"
    file.write_bytes(parts_of(path)[1]["model"])
    return read_gaussians(file)


def start_of(path, size):
    """The view at which a page of a size starts, in the frame of its file."""
    camera = parts_of(path)[0]["settings"]["camera"]
    place, target = FLIP @ camera["position"], FLIP @ camera["target"]
    z = (target - place) / np.linalg.norm(target - place)
    x = np.cross([0.0, 1.0, 0.0], z)  # level: the viewer's up is -y of the file
    x /= np.linalg.norm(x)
    cam_from_file = np.eye(4)
    cam_from_file[:3, :3] = x, np.cross(z, x), z
    cam_from_file[:3, 3] = -cam_from_file[:3, :3] @ place
    width, height = size  # the field of view is that of the longer side
    fov = 2 * np.arctan(np.tan(np.radians(camera["fov"]) / 2) * height / max(width, height))
    return pinhole_view(size, fov, cam_from_file)


def test_the_page_starts_at_an_upright_training_camera(page, tmp_path):
    path, item, _ = page
    frame, cameras = viewer_frame(item), [view.camera for view in item.central_views]
    held, view = model_of(path, tmp_path), start_of(path, (600, 400))
    # The similarity from the world, by the Gaussians' medians along its axes.
    up = up_direction(cameras)
    heights = held.means @ [0.0, -1.0, 0.0]
    expected = frame.scale * ((item.model.means - frame.origin) @ up)
    np.testing.assert_allclose(np.sort(heights), np.sort(expected), atol=2e-3)
    places = [frame.scale * np.linalg.norm(c.center - frame.origin) for c in cameras]
    assert np.abs(places - np.linalg.norm(view.camera.center)).min() < 1e-6
    nearest = cameras[np.abs(places - np.linalg.norm(view.camera.center)).argmin()]
    pitch = -view.camera.cam_from_world[2, 1]
    assert pitch == pytest.approx(nearest.world_from_cam[:3, 2] @ up, abs=1e-6)
    # The whole image fits into a window of 3 by 2.
    assert nearest.width / nearest.K[0, 0] <= 600 / view.camera.K[0, 0] * (1 + 1e-6)
    assert nearest.height / nearest.K[1, 1] <= 400 / view.camera.K[1, 1] * (1 + 1e-6)
    assert parts_of(path)[0]["settings"]["background"]["color"] == [10 / 255, 20 / 255, 60 / 255]


def test_the_page_has_the_viewer_as_published_with_its_licence(page):
    path, item, _ = page
    text = path.read_text("utf-8")
    assert "<title>a &lt;b&gt; &amp; c</title>" in text
    assert "Copyright (c) 2011-2026 PlayCanvas Ltd." in text
    assert b'var version = "1.36.2";' in gzip.decompress(parts_of(path)[1]["code"])
    assert not re.findall(r"""(?:src|href)\s*=\s*["']([^"']*)""", text)
    assert not re.findall(r"https?://[\w./]+", text)
    assert len(text) < 1.1e6 + 80 * len(item.model)


def test_gaussians_have_the_blur_of_training(page, tmp_path):
    _, item, _ = page
    model, view = item.model, item.train_views[0]
    seen = web_page.points_in_image(view.camera, model.means)
    larger = web_page._as_trained(model, [view])
    before, after = (np.exp(2.0 * each.scales) for each in (model, larger))
    pixels = seen.depth**2 / (view.camera.K[0, 0] * view.camera.K[1, 1])
    expected = 1.076 * (before[seen.point_idx] + 0.3 * pixels[:, None])
    np.testing.assert_allclose(after[seen.point_idx], expected, rtol=1e-4)
    unseen = np.setdiff1d(np.arange(len(model)), seen.point_idx)
    np.testing.assert_allclose(after[unseen], 1.076 * before[unseen], rtol=1e-4)
    undone = web_page._as_trained(larger, [view], undo=True)
    np.testing.assert_allclose(undone.scales, model.scales, atol=1e-3)
    sharp = web_page._as_trained(dataclasses.replace(model, antialiased=True), [view])
    np.testing.assert_allclose(np.exp(2.0 * sharp.scales), 1.076 * before, rtol=1e-4)


def test_the_gaussians_returned_are_those_of_the_page_in_the_world(page):
    _, item, shown = page
    distance, order = cKDTree(item.model.means).query(shown.means)
    assert sorted(order) == list(range(len(item.model)))
    assert distance.max() < 1e-3
    for field, error in (("scales", 0.05), ("opacities", 0.03), ("sh0", 0.02), ("shN", 0.02)):
        ours, theirs = getattr(shown, field), getattr(item.model, field)[order]
        np.testing.assert_allclose(ours, theirs, atol=error, err_msg=field)


@pytest.mark.skipif(browser.CHROMIUM is None, reason="Chromium is not installed")
def test_a_browser_draws_the_page_from_disk_as_splatseed_renders(page, tmp_path):
    path = page[0]
    with served_page(tmp_path / "profile", path) as opened:
        loaded = "!!window.viewer?.state.loaded && viewer.state.cameraMode === 'orbit'"
        assert waits_for(lambda: opened.run(loaded), 60)
        opened.run("document.querySelector('.sse-ui').style.display = 'none'")
        view, held = start_of(path, (800, 600)), model_of(path, tmp_path)
        # The viewer blurs by a quarter of what splatseed does, by which the file is larger.
        frame = TrainingFrame(np.zeros(3), 1.0)
        plain = dataclasses.replace(held, shN=np.zeros_like(held.shN))
        own, without = (
            ModelRenderer(model, frame, background=NAVY).image(view).clamp(0, 1).numpy() * 255
            for model in (held, plain)
        )

        def likeness(image):
            return 10 * np.log10(255**2 / np.mean((screenshot(opened) - image) ** 2))

        assert waits_for(lambda: likeness(own) > 38, 20), likeness(own)
        assert likeness(without) < 32  # the harmonics are seen
        assert all(url.startswith(("file:", "data:", "blob:")) for url in opened.requests)
        adapters = "No available adapters."  # for WebGPU, without a GPU
        assert not [e for e in opened.errors if adapters not in str(e)]


def test_a_page_that_browsers_cannot_load_is_refused(run_folder, tmp_path, monkeypatch, splatseed):
    with pytest.raises(OutputError, match=r"at most 4,000,000 .* found 5,000,000, 200 MB"):
        check_page_size(5_000_000)
    monkeypatch.setattr(web_page, "MAX_GAUSSIANS", 10)
    run = splatseed("export", run_folder, "-o", tmp_path / "out.html")
    assert run.code == 2
    assert "--min-opacity" in run.err
    assert not list(tmp_path.iterdir())


def test_export_writes_the_page_of_a_run_or_a_file(run_folder, tmp_path, splatseed):
    out = tmp_path / "out.HTML"
    run = splatseed("export", run_folder, "-o", out, "--min-opacity", 0.5)
    assert run.code == 0, run.err
    assert out.as_uri() in run.out
    assert "out.sog" in run.out.split("next")[1]
    assert "<title>run</title>" in out.read_text("utf-8")
    alone = tmp_path / "alone.ply"
    write_gaussians(alone, dataclasses.replace(read_gaussians(run_folder), antialiased=True))
    run = splatseed("export", alone, "-o", tmp_path / "alone.html")
    assert run.code == 0, run.err
    options, _ = parts_of(tmp_path / "alone.html")
    assert options["aa"] is True
    assert options["settings"]["background"]["color"] == [0, 0, 0] == list(BLACK)
    assert export.PAGE in splatseed("export", alone, "-o", tmp_path / "a.htm").err
