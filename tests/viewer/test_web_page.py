"""A page of a run: the model is inside, nothing else is asked for, and a browser draws it."""

from __future__ import annotations

import base64
import dataclasses
import re

import numpy as np
import pytest

msgspec = pytest.importorskip("msgspec", reason="viser is not installed")
zstandard = pytest.importorskip("zstandard")
pytest.importorskip("viser")

from splatseed.commands import export
from splatseed.errors import OutputError
from splatseed.splat.formats import read_gaussians, write_gaussians
from splatseed.splat.gaussians import SH_C0, Gaussians
from splatseed.viewer import web_page
from splatseed.viewer.flights import orbit
from splatseed.viewer.models import ViewerItem, item_of_model, viewer_frame
from splatseed.viewer.page import GROUND
from splatseed.viewer.web_page import check_page_size, mean_colors, page_covariances, write_page

from ..bench import browser
from .test_viewer import screenshot, served_page, waits_for

ROW = np.dtype(
    [("at", "<f4", 3), ("free", "<u4"), ("covariance", "<f2", 6), ("rgba", "u1", 4)]
)  # of viser's splats


@pytest.fixture(scope="module")
def page(run_folder, tmp_path_factory):
    """The page of the run, whose splats have sizes and turns of their own."""
    rng, path = np.random.default_rng(0), tmp_path_factory.mktemp("page") / "a <b> & c.html"
    model = read_gaussians(run_folder)
    scales = model.scales + rng.normal(0, 0.5, model.scales.shape).astype(np.float32)
    quats = rng.normal(size=model.quats.shape).astype(np.float32)
    model = dataclasses.replace(model, scales=scales, quats=quats)
    item = item_of_model("a <b> & c", run_folder / "point_cloud.ply", model)
    write_page(path, item)
    return path, item


def messages_of(path):
    """The messages inside of a page by type, and their buffers."""
    text = path.read_text("utf-8")
    data = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]*)"', text)[1])
    size = int.from_bytes(data[:8], "little")
    inner = zstandard.ZstdDecompressor().decompress(data[8:], max_output_size=size)
    head = int.from_bytes(inner[:8], "little")
    content = msgspec.msgpack.decode(inner[8 : 8 + head])
    (length,) = (n for n in content["binaryBufferLengths"] if n >= 32)
    return {m["type"]: m for _, m in content["messages"]}, inner[-length:]


def test_the_page_has_the_model_in_viser_units(page):
    path, item = page
    messages, buffer = messages_of(path)
    model, frame = item.model, viewer_frame(item)
    splats = messages["GaussianSplatsMessage"]["props"]
    rows = np.frombuffer(buffer, ROW)
    assert len(rows) == len(model)
    scale = splats["scale"]
    expected = (model.means - frame.origin) * frame.scale
    np.testing.assert_allclose(rows["at"] * scale, expected, atol=1e-5)
    # Each covariance by its definition, for some.
    for i in range(0, len(model), len(model) // 20):
        w, x, y, z = model.quats[i] / np.linalg.norm(model.quats[i])
        R = np.array(
            [
                [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
            ]
        )
        S = np.diag(np.exp(2.0 * model.scales[i])) * frame.scale**2
        covariance = (R @ S @ R.T)[np.triu_indices(3)]
        stored = rows["covariance"][i].astype(float) * scale**2
        np.testing.assert_allclose(stored, covariance, atol=2e-3 * np.abs(covariance).max())
    np.testing.assert_array_equal(rows["rgba"][:, 3], 230)  # opacity 0.9
    plain = np.rint(255 * np.clip(0.5 + SH_C0 * model.sh0[:, 0], 0, 1))
    np.testing.assert_allclose(rows["rgba"][:, :3], plain, atol=1)
    first = item.train_views[0].camera
    place = (first.center - frame.origin) * frame.scale
    np.testing.assert_allclose(messages["SetCameraPositionMessage"]["position"], place, atol=1e-6)
    ahead = np.array(messages["SetCameraLookAtMessage"]["look_at"]) - place
    np.testing.assert_allclose(ahead, first.world_from_cam[:3, 2], atol=1e-6)
    assert messages["BackgroundImageMessage"]["format"] == "png"


def test_the_page_asks_for_nothing_else(page):
    text = page[0].read_text("utf-8")
    head = text[: text.index("__VISER_EMBED_DATA__")]
    assert "<title>a &lt;b&gt; &amp; c</title>" in head
    sources = re.findall(r"""(?:src|href)\s*=\s*["']([^"']*)""", text)
    assert all(source.startswith("data:") for source in sources)
    assert set(re.findall(r"https?://[\w./]+", text)) <= {"http://www.w3.org/2000/svg"}
    assert len(text) < 1.2e6 + 40 * len(page[1].model)


def test_a_browser_draws_the_page_from_disk_in_order_of_depth(tmp_path):
    """Which viser's own page does not: Chrome refuses its worker there."""
    if browser.CHROMIUM is None:
        pytest.skip("chromium is not installed (Debian: apt-get install chromium)")
    means = np.array([[0.7, 0.0, 0.0], [-0.7, 0.0, 0.0]], np.float32)
    model = Gaussians(
        means=means,
        scales=np.full((2, 3), np.log(0.15), np.float32),
        quats=np.array([[1, 0, 0, 0]] * 2, np.float32),
        opacities=np.full(2, 8.0, np.float32),
        sh0=np.array([[[1.5, -1.5, -1.5]], [[-1.5, -1.5, 1.5]]], np.float32),  # red and blue
        shN=np.zeros((2, 0, 3), np.float32),
    )
    # Red right in front of blue, and before it in the file: drawn last only if sorted.
    ahead = orbit([], model, 1, (600, 400))[0].camera.world_from_cam[:3, 2]
    model = dataclasses.replace(model, means=np.float32([-0.7 * ahead, 0.7 * ahead]))
    write_page(tmp_path / "page.html", ViewerItem("page", None, model))

    def shows(color):
        middle = screenshot(shown)[300, 400].astype(int)
        return np.abs(middle - color).max() < 40

    with served_page(tmp_path / "profile", tmp_path / "page.html") as shown:
        assert waits_for(lambda: shows((236, 20, 20)), 60)
        np.testing.assert_allclose(screenshot(shown)[590, 10], GROUND, atol=3)
        assert all(url.startswith(("file:", "data:", "blob:")) for url in shown.requests)
        assert not [error for error in shown.errors if "orker" in str(error)]


def test_colours_are_means_over_the_cameras_that_see_a_gaussian(page):
    item = page[1]
    model, views = item.model, item.train_views[:2]
    shN = np.zeros((len(model), 3, 3), np.float32)
    shN[:, 1] = 0.3  # of z
    lit = dataclasses.replace(model, shN=shN)
    colors = mean_colors(lit, views)
    i = next(
        i
        for i, x in enumerate(model.means)
        if all(np.all((uv := v.camera.project(x[None]))[1] > 0.1)
               and np.all((uv[0] > 0) & (uv[0] < [v.camera.width, v.camera.height])) for v in views)
    )  # fmt: skip
    expected, weight = np.zeros(3), 0.0
    for view in views:
        ray = model.means[i] - view.camera.center
        length = np.linalg.norm(ray)
        seen = 0.5 + SH_C0 * model.sh0[i, 0] + 0.4886025 * ray[2] / length * 0.3
        expected, weight = expected + np.clip(seen, 0, 1) / length**2, weight + 1 / length**2
    np.testing.assert_allclose(colors[i], 255 * expected / weight, atol=0.51)
    away = dataclasses.replace(lit, means=np.full_like(model.means, 1e6))
    np.testing.assert_array_equal(mean_colors(away, views), mean_colors(model, ()))


def test_huge_gaussians_are_clipped_for_the_sake_of_small_ones(page):
    model = page[1].model
    scales = np.full_like(model.scales, -4.0)
    scales[0] = 12.0
    covariances, unit, clipped = page_covariances(dataclasses.replace(model, scales=scales), 1.0)
    assert clipped == 1
    assert np.isfinite(covariances.astype(np.float16)).all()
    small = np.trace(covariances[1].astype(np.float16)) / 3 / unit**2
    assert small == pytest.approx(np.exp(-8.0), rel=2e-3)


def test_a_page_that_browsers_cannot_load_is_refused(run_folder, tmp_path, monkeypatch, splatseed):
    with pytest.raises(OutputError, match=r"at most 4,000,000 .* found 5,000,000, 175 MB"):
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
    assert run.out.rstrip().splitlines()[-1].endswith(out.as_uri())
    assert "<title>run</title>" in out.read_text("utf-8")
    alone = tmp_path / "alone.ply"
    write_gaussians(alone, dataclasses.replace(read_gaussians(run_folder), antialiased=True))
    run = splatseed("export", alone, "-o", tmp_path / "alone.html")
    assert run.code == 0, run.err
    assert "antialiased rendering, which a web page cannot record" in " ".join(run.err.split())
    messages, _ = messages_of(tmp_path / "alone.html")
    assert "GaussianSplatsMessage" in messages
    assert export.PAGE in splatseed("export", alone, "-o", tmp_path / "a.htm").err
