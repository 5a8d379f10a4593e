"""Renders and transparent pixels have the background that a model was trained on."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.errors import ParameterError
from splatseed.io import load_scene
from splatseed.io.photograph import read_photograph
from splatseed.splat.background import parse_background, recorded_background
from splatseed.splat.formats import write_gaussians
from splatseed.splat.gaussians import Gaussians

WHITE = (255, 255, 255)


@pytest.mark.parametrize(
    ("name", "content", "color"),
    [
        ("cfg_args", "Namespace(eval=True, white_background=True)", WHITE),
        ("cfg_args", "Namespace(white_background=False, sh_degree=3)", (0, 0, 0)),
        ("cfg_args", "Namespace(eval=True)", None),
        ("cfg.yml", "sh_degree: 3\nwhite_background: true\n", WHITE),
        ("config.yml", "model:\n    background_color: white\n    sh_degree: 3\n", WHITE),
        ("config.yml", "    background_color: random\n", None),
        ("config.yml", "  alpha_color: white\n    background_color: random\n", WHITE),
        ("config.yml", "  alpha_color: null\n    background_color: black\n", (0, 0, 0)),
    ],
)
def test_records_of_trainers_are_read(name, content, color, tmp_path):
    (tmp_path / name).write_text(content)
    model = tmp_path / "point_cloud/iteration_30000/point_cloud.ply"
    found = recorded_background(model)
    assert (None if found is None else found.color) == color


def test_a_background_is_a_name_or_three_numbers():
    assert parse_background("0, 128,255") == (0, 128, 255)
    for text in ("gray", "1,2", "1,2,256", "-1,2,3", ""):
        with pytest.raises(ParameterError, match="background"):
            parse_background(text)


def test_transparent_pixels_of_8_and_16_bits_are_composited_over_the_background(tmp_path):
    rgb, alpha = np.array([[[200, 100, 0], [10, 20, 30]]], np.uint8), np.array([[128, 0]], np.uint8)
    path = tmp_path / "a.png"
    PilImage.fromarray(np.dstack([rgb, alpha])).save(path)
    # a c + (1 - a) b
    half = 128 / 255
    expected = [
        [np.array([200, 100, 0]) * half + np.array([40, 255, 0]) * (1 - half), [40, 255, 0]]
    ]
    found = read_photograph(path, background=(40, 255, 0))
    assert np.abs(found - np.array(expected)).max() < 1.01
    cut = read_photograph(path, composited=False, background=WHITE)
    assert cut.tolist() == [[[200, 100, 0], [255, 255, 255]]]
    PilImage.fromarray(np.array([[0, 40000]], np.uint16)).save(path, transparency=0)
    assert read_photograph(path, background=WHITE)[0, 0].tolist() == [255, 255, 255]


@pytest.fixture
def blender(tmp_path):
    """A pair of 24 x 24 px in which the lower half is transparent, and Gaussians before it."""
    for split, count in (("train", 3), ("test", 1)):
        frames = []
        for i in range(count):
            pose = np.eye(4)
            pose[0, 3] = 0.1 * i
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
            pixels = np.random.default_rng(i).integers(0, 256, (24, 24, 4), np.uint8)
            pixels[..., 3] = np.where(np.arange(24) < 12, 255, 0)[:, None]
            pixels[11, :, 3] = 100
            (tmp_path / split).mkdir(exist_ok=True)
            PilImage.fromarray(pixels).save(tmp_path / split / f"r_{i}.png")
        content = {"camera_angle_x": 0.9, "frames": frames}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(content))
    rng, folder = np.random.default_rng(7), tmp_path / "out/point_cloud/iteration_7"
    arrays = {
        "means": np.column_stack([rng.uniform(-1, 1, (40, 2)), np.full(40, -3.0)]),
        "scales": np.full((40, 3), np.log(0.1)),
        "quats": np.tile([1.0, 0, 0, 0], (40, 1)),
        "opacities": rng.normal(0, 1, 40),
        "sh0": rng.normal(0, 1, (40, 1, 3)),
        "shN": np.zeros((40, 0, 3)),
    }
    folder.mkdir(parents=True)
    model = Gaussians(**{name: array.astype(np.float32) for name, array in arrays.items()})
    write_gaussians(folder / "point_cloud.ply", model)
    return tmp_path, folder / "point_cloud.ply", model


def test_a_model_trained_on_white_is_scored_on_white(blender):
    torch = pytest.importorskip("torch", reason="scoring needs PyTorch")
    from splatseed.rendering import rasterization
    from splatseed.splat.evaluate import evaluate_model, load_model

    root, path, model = blender
    scene = load_scene(root, require_points=False)
    (image,) = scene.split()[1]
    t = torch.tensor
    color, alpha, _ = rasterization(
        t(model.means), t(model.quats), torch.exp(t(model.scales)),
        torch.sigmoid(t(model.opacities)),
        t(model.sh0), t(image.cam_from_world, dtype=torch.float32)[None],
        t(image.K, dtype=torch.float32)[None], 24, 24, sh_degree=0, packed=False,
    )  # fmt: skip
    stored = np.asarray(PilImage.open(image.path)).astype(float) / 255

    def expected(background):
        render = np.clip(color[0].numpy() + (1 - alpha[0].numpy()) * background, 0, 1)
        photograph = stored[..., :3] * stored[..., 3:] + (1 - stored[..., 3:]) * background
        return -10 * np.log10(((render - photograph) ** 2).mean())

    def scored(**options):
        loaded = load_model(path, scene, **options)
        return evaluate_model(loaded).psnr, [f for f in loaded.findings if f.kind == "background"]

    assert scored(background="black")[0] == pytest.approx(expected(0.0), abs=0.02)
    (path.parents[2] / "cfg_args").write_text("Namespace(white_background=True)")
    psnr, (finding,) = scored()
    assert psnr == pytest.approx(expected(1.0), abs=0.02)
    assert finding.severity == "info"
    assert "cfg_args" in finding.text
    (path.parents[2] / "cfg_args").unlink()
    assert scored()[0] == pytest.approx(expected(0.0), abs=0.02)
    # White Gaussians in the empty half vanish on white only: this is said without a record.
    low = np.flatnonzero(model.means[:, 1] < 0)
    colors = model.sh0.copy()
    colors[low] = 0.5 / 0.28209479
    arrays = model.arrays() | {"sh0": colors, "opacities": np.full(40, 4, np.float32)}
    write_gaussians(path, Gaussians(**arrays))
    psnr, (finding,) = scored()
    assert (finding.severity, psnr < scored(background="white")[0]) == ("warning", True)
