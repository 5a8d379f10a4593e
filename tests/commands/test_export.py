"""``splatseed export``: any model to any format, cropped and cleaned."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from splatseed.io import load_scene
from splatseed.splat.formats import read_gaussians, write_gaussians
from splatseed.splat.from_seeds import initial_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.selection import largest, visible_area


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
    assert "upside down" in splatseed("export", out, "-o", tmp_path / "again.ply").err
    assert "upside down" not in splatseed("export", out, "-o", tmp_path / "again.spz").err


def test_gaussians_left_out_are_noted_once(model, splatseed, tmp_path):
    whole = read_gaussians(model)
    scales, means = whole.scales.copy(), whole.means.copy()
    scales[5, 0], means[7] = np.nan, 1e9
    write_gaussians(tmp_path / "broken.ply", replace(whole, scales=scales, means=means))
    run = splatseed("export", tmp_path / "broken.ply", "-o", tmp_path / "out.spz")
    assert run.code == 0, run
    said = " ".join(run.err.split())
    assert said.count("no usable size") == 1
    assert said.count("1 Gaussian of 399 ") == 1
    assert len(read_gaussians(tmp_path / "out.spz")) == 398


@pytest.fixture
def of_room(room, tmp_path):
    """The room's points as Gaussians, which show it."""
    model = initial_gaussians(load_scene(room).points, opacity=0.9)
    path = tmp_path / "room.ply"
    write_gaussians(path, model)
    return path


def numbers(text, row):
    """The numbers in dB of a row of the output."""
    (line,) = (line for line in text.splitlines() if line.strip().startswith(f"{row}  "))
    return [
        float(word) for word in line.split(";")[0].replace(",", "").split() if word[0].isdigit()
    ]


def test_what_a_format_costs_is_told(of_room, room, splatseed, tmp_path, rng):
    """Of the file as it is read back, against photographs, else against the model's renders."""
    pytest.importorskip("gsplat", reason="scenes are compared with extra train")
    words = ("export", of_room, "-o", tmp_path / "out.spz", "--overwrite")
    faithful = splatseed(*words, "--scene", room)
    before, after = numbers(faithful.out, "score")
    assert before > 12
    assert abs(before - after) < 0.1
    assert "2 test views" in faithful.out
    fewer = splatseed(*words, "--scene", room, "--exclude", "view_000*")
    assert "1 test view" in fewer.out
    assert "1 photograph is left out: view_000.png" in fewer.err
    assert "--exclude 'view_000*'" in fewer.out
    assert numbers(fewer.out, "score") != numbers(faithful.out, "score")
    assert splatseed(*words, "--exclude", "view_000*").code == 2  # no scene
    assert numbers(splatseed(*words).out, "likeness")[0] > 40
    assert "costs the model" not in faithful.out + faithful.err
    model = read_gaussians(of_room)  # beyond what an .spz holds
    shN = rng.choice(np.float32([-3, 3]), model.shN.shape)
    write_gaussians(of_room, replace(model, shN=shN))
    strong = splatseed(*words)
    assert numbers(strong.out, "likeness")[0] < 30
    assert "Renders of the .spz differ" in " ".join((strong.out + strong.err).split())
    whole = splatseed("export", of_room, "-o", tmp_path / "out.ply")
    assert "likeness" not in whole.out


def test_a_budget_keeps_what_the_views_need(of_room, room, splatseed, tmp_path):
    pytest.importorskip("gsplat", reason="scenes are compared with extra train")
    model, out = read_gaussians(of_room), tmp_path / "out.ply"
    # As many again that no view sees, larger and more opaque than all others.
    behind = replace(
        model,
        means=model.means + np.float32([0, 0, 80]),
        scales=model.scales + 1,
        opacities=model.opacities + 1,
    )
    both = {n: np.concatenate([model.arrays()[n], behind.arrays()[n]]) for n in model.arrays()}
    write_gaussians(of_room, Gaussians(**both))
    done = splatseed("export", of_room, "-o", out, "--scene", room, "--budget", len(model))
    assert done.code == 0, done
    kept = read_gaussians(out)
    assert len(kept) == len(model)
    assert np.isin(kept.means[:, 2], model.means[:, 2]).mean() > 0.9
    before, after = numbers(done.out, "score")
    assert abs(before - after) < 0.1
    # Without a scene: by opacity and size.
    done = splatseed("export", of_room, "-o", out, "--budget", len(model), "--overwrite")
    assert "by opacity and area" in done.out
    whole = read_gaussians(of_room)
    expected = whole.select(largest(visible_area(whole), len(model)))
    np.testing.assert_allclose(read_gaussians(out).scales, expected.scales)


def test_a_moved_model_is_where_it_was_sent(model, splatseed, tmp_path):
    matrix = np.array([[0, -2, 0, 5], [2, 0, 0, 0], [0, 0, 2, -1], [0, 0, 0, 1.0]])
    np.savetxt(tmp_path / "move.txt", matrix)
    whole, out = read_gaussians(model), tmp_path / "out.ply"
    moved = whole.means @ matrix[:3, :3].T + matrix[:3, 3]
    for text in (tmp_path / "move.txt", " ".join(map(str, matrix.ravel()))):
        run = splatseed("export", model, "-o", out, "--overwrite", f"--transform={text}")
        assert run.code == 0, run
        np.testing.assert_allclose(read_gaussians(out).means, moved, atol=1e-5)
    # The crop is in the coordinates of the model that is read.
    run = splatseed(
        "export", model, "-o", out, "--overwrite", f"--transform={tmp_path / 'move.txt'}",
        "--crop=0,0,0,0.7",
    )  # fmt: skip
    inside = np.linalg.norm(whole.means, axis=1) <= 0.7
    np.testing.assert_allclose(read_gaussians(out).means, moved[inside], atol=1e-5)
    # A packed file is compared with the model where it was.
    (likeness,) = numbers(
        splatseed(
            "export", model, "-o", tmp_path / "out.spz", f"--transform={tmp_path / 'move.txt'}"
        ).out,
        "likeness",
    )
    assert likeness > 40
    np.savetxt(tmp_path / "move.txt", matrix * [[1], [1], [-1], [1]])
    run = splatseed(
        "export", model, "-o", tmp_path / "no.ply", "--transform", tmp_path / "move.txt"
    )
    assert run.code == 2
    assert "--transform" in run.err
    assert "mirror" in run.err
    assert not (tmp_path / "no.ply").exists()


def test_isolated_gaussians_are_dropped_on_request(model, splatseed, tmp_path):
    whole = read_gaussians(model)
    means, opacities = whole.means.copy(), np.full(len(whole), 3, np.float32)
    means[:5] = 40 + 10 * np.arange(5)[:, None]
    scales = np.full_like(whole.scales, np.log(0.15))
    write_gaussians(model, replace(whole, means=means, opacities=opacities, scales=scales))
    run = splatseed("export", model, "-o", tmp_path / "out.ply", "--drop-isolated")
    assert "5 left out" in run.out
    np.testing.assert_array_equal(read_gaussians(tmp_path / "out.ply").means, means[5:])
