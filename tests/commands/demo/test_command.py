"""``splatseed demo``, with few photographs."""

from __future__ import annotations

import csv

import numpy as np
import pycolmap
import pytest
from PIL import Image as PilImage

from splatseed.io import load_scene
from splatseed.upsample import METHODS


@pytest.mark.slow
def test_demo_leaves_a_scene_scores_and_pictures(tmp_path, splatseed):
    out = tmp_path / "demo"
    run = splatseed("demo", "--views", 6, "--ratio", 4, "--train-steps", 0, "-o", out)
    assert (run.code, run.err) == (0, "")
    for name in ("preview.png", "preview_methods.png", "preview_errors.png"):
        assert str(out / name) in run.out
        with PilImage.open(out / name) as picture:
            assert np.ptp(np.asarray(picture.convert("RGB")), axis=2).max() > 50
    scores = _scores(out / "geometry.csv")
    assert set(scores) == {"originals", *METHODS} - {"cloud"}  # which needs a scan
    # What any upsampling is for, and what strewing points at random does not give.
    assert scores["mls"]["coverage_h"] < scores["originals"]["coverage_h"]
    assert scores["mls"]["error_h"] < scores["random"]["error_h"]
    assert pycolmap.Reconstruction(out / "scene/sparse/0").num_images() == 6
    before, after = load_scene(out / "scene"), load_scene(out / "scene_auto")
    assert len(after.points) > 2 * len(before.points)
    assert not before.warnings
    assert after.points.num_original == len(before.points)
    run = splatseed("demo", "--views", 6, "-o", out)
    assert (run.code, "--overwrite" in run.err) == (2, True)


def _scores(path):
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {row.pop("method"): {k: float(v) for k, v in row.items()} for row in rows}


@pytest.mark.parametrize("words", [["--views", 2], ["--views", 4, "--ratio", 0.5]])
def test_a_demo_that_cannot_be_leaves_nothing(words, tmp_path, splatseed):
    run = splatseed("demo", "-o", tmp_path / "demo", *words)
    assert (run.code, run.err.count("\n")) == (2, 1)
    assert not list(tmp_path.iterdir())
