"""``splatseed export``: any model to any format, cropped and cleaned."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from splatseed.splat.formats import read_gaussians, write_gaussians
from splatseed.splat.gaussians import Gaussians


@pytest.fixture
def model(rng, tmp_path):
    """A file of 400 Gaussians in a cube from -1 to 1, every other one nearly transparent."""
    opacities = np.where(np.arange(400) % 2, 3.0, -6.0)
    arrays = {
        "means": rng.uniform(-1, 1, (400, 3)),
        "scales": np.full((400, 3), -3.0),
        "quats": rng.normal(size=(400, 4)),
        "opacities": opacities,
        "sh0": rng.normal(size=(400, 1, 3)),
        "shN": 0.1 * rng.normal(size=(400, 15, 3)),
    }
    path = tmp_path / "model.ply"
    write_gaussians(path, Gaussians(**{k: a.astype(np.float32) for k, a in arrays.items()}))
    return path


def test_a_run_is_exported_cropped_cleaned_and_can_be_scored(model, splatseed, tmp_path):
    folder, out = tmp_path / "run", tmp_path / "out.spz"
    folder.mkdir()
    config = {"scene": "/data/my scene", "data_factor": 2, "test_every": 5, "masks": "/my/m"}
    for name, content in (("config.json", config), ("splatseed.json", {})):
        (folder / name).write_text(json.dumps(content))
    model.rename(folder / "point_cloud.ply")
    how = ("--crop=-1,-1,0,1,1,1", "--min-opacity", 0.05, "--overwrite")
    for named in ("", "point_cloud.ply"):
        run = splatseed("export", folder / named, "-o", out, *how)
        assert run.code == 0, run
        said = " ".join(run.out.split())
        assert (
            f"{out} --scene '/data/my scene' --data-factor 2 --test-every 5 --masks /my/m" in said
        )
        assert f"splatseed view {out}" in said
    kept = read_gaussians(out)
    assert 70 < len(kept) < 130
    assert kept.means[:, 2].min() > -0.01
    assert "upside down" in splatseed("export", out, "-o", tmp_path / "again.ply").out
    assert "upside down" not in splatseed("export", out, "-o", tmp_path / "again.spz").out


def test_gaussians_left_out_are_noted_once(model, splatseed, tmp_path):
    whole = read_gaussians(model)
    scales, means = whole.scales.copy(), whole.means.copy()
    scales[5, 0], means[7] = np.nan, 1e9
    write_gaussians(tmp_path / "broken.ply", replace(whole, scales=scales, means=means))
    run = splatseed("export", tmp_path / "broken.ply", "-o", tmp_path / "out.spz")
    assert run.code == 0, run
    said = " ".join(run.out.split())
    assert said.count("no usable size") == 1
    assert said.count("1 Gaussian of 399 ") == 1
    assert len(read_gaussians(tmp_path / "out.spz")) == 398
