"""``splatseed upsample --gaussians``: the file, and what is refused."""

from __future__ import annotations

import numpy as np

from splatseed.io import load_scene
from splatseed.splat.formats import read_model


def test_the_first_gaussians_stand_where_the_seeds_are(room, tmp_path, splatseed):
    out, start = tmp_path / "out", tmp_path / "start.ply"
    run = splatseed(
        "upsample", room, "--method", "mls", "--ratio", 2, "-o", out, "--gaussians", start
    )
    assert run.code == 0, run.err
    assert str(start) in run.out + run.err
    gaussians, seeds = read_model(start), load_scene(out).points
    assert len(gaussians) == len(seeds)
    extent = np.ptp(seeds.xyz, axis=0).max()
    np.testing.assert_allclose(gaussians.means, seeds.xyz, atol=1e-6 * extent)
    sizes = np.exp(gaussians.scales)
    assert (sizes > 0).all()
    assert (sizes < extent).all()
    own = seeds.rgb / 255.0
    fitted = 0.5 + 0.28209479 * gaussians.sh0[:, 0]
    assert 0 < np.abs(fitted - own).mean() < 0.2  # of the photographs, near the seeds' own


def test_bad_places_are_refused_before_anything_is_written(room, tmp_path, splatseed):
    out, taken = tmp_path / "out", tmp_path / "taken.ply"
    taken.write_text("mine")
    for name, said in (
        (taken, "--overwrite"),
        (tmp_path / "start.splat", "FILE.ply"),
        (out / "start.ply", "beside the folder"),
    ):
        run = splatseed("upsample", room, "--method", "mls", "-o", out, "--gaussians", name)
        assert run.code == 2
        assert said in " ".join(run.err.split())
        assert not out.exists()
    assert taken.read_text() == "mine"
