"""The formulas of other trainers' scores, against libraries that they call."""

from __future__ import annotations

from importlib import import_module

import numpy as np
import pytest

from .conftest import ROOT

torch = pytest.importorskip("torch", reason="scores need PyTorch")


@pytest.fixture
def conventions(monkeypatch):
    pytest.importorskip("flip_evaluator", reason="scores need extra train")
    monkeypatch.syspath_prepend(ROOT)
    return import_module("benchmarks.score_conventions")


@pytest.fixture
def pair(rng):
    photograph = torch.from_numpy(rng.uniform(size=(40, 50, 3)).astype(np.float32))
    noise = torch.from_numpy(rng.normal(0, 0.1, (40, 50, 3)).astype(np.float32))
    return photograph + noise, (photograph * 255).round() / 255


def test_edges_are_what_ssims_of_other_scripts_differ_in(conventions, pair):
    """Away from the edges graphdeco's, nerfstudio's and torchmetrics' are one."""
    theirs = pytest.importorskip("torchmetrics.functional.image")
    x, y = pair[0].clamp(0, 1), pair[1]
    batches = (image.double().permute(2, 0, 1)[None] for image in (x, y))
    _, full = theirs.structural_similarity_index_measure(
        *batches, data_range=1.0, return_full_image=True
    )
    inside = float(full[..., 5:-5, 5:-5].mean())
    scores = {name.partition(":")[0]: score(*pair) for name, score in conventions.SSIMS.items()}
    assert scores["ours, gsplat"] == pytest.approx(float(full.mean()), abs=1e-5)
    assert scores["nerfstudio"] == pytest.approx(inside, abs=1e-9)
    # A convolution with zeros around, as graphdeco's loss_utils.py has it.
    a, b = (conventions.rounded(image).double().permute(2, 0, 1)[None] for image in pair)
    line = torch.exp(-torch.arange(-5.0, 6, dtype=torch.float64).square() / 4.5)
    window = torch.outer(line, line).expand(3, 1, 11, 11) / line.sum() ** 2

    def blurred(image):
        return torch.nn.functional.conv2d(image, window, padding=5, groups=3)

    m, n = blurred(a), blurred(b)
    top = (2 * m * n + 1e-4) * (2 * (blurred(a * b) - m * n) + 9e-4)
    spread = blurred(a * a) - m * m + blurred(b * b) - n * n
    expected = float((top / ((m * m + n * n + 1e-4) * (spread + 9e-4))).mean())
    assert scores["graphdeco"] == pytest.approx(expected, abs=1e-9)
    assert scores["graphdeco"] != pytest.approx(scores["nerfstudio"], abs=1e-4)


def test_what_is_clamped_and_rounded(conventions):
    """One pixel of a bright render of 1.2 over white, in 100 of 0.5 that are off by 0.001."""
    photograph = torch.full((10, 10, 3), 0.5)
    render = photograph + 0.001
    render[0, 0], photograph[0, 0] = 1.2, 1.0
    values = {
        name.partition(":")[0]: f(render, photograph) for name, f in conventions.PSNRS.items()
    }
    assert values["ours, gsplat, nerfstudio, LichtFeld Studio"] == pytest.approx(60.04, abs=0.02)
    assert values["Brush"] == pytest.approx(10 * np.log10(100 / 0.04), abs=0.05)
    # 0.501 and 0.5 become the same byte, 128.
    assert values["graphdeco"] > 100 or np.isinf(values["graphdeco"])
