"""``splatseed tune``: test views are never read, halving keeps the best, and it can be stopped."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from contextlib import contextmanager

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")

from splatseed.bench import tuning
from splatseed.bench.plan import Arm
from splatseed.bench.tuning import (
    Rung,
    best_arms,
    growth_within,
    make_validation_scene,
    plan_rungs,
    steps_to_grow,
    verdict,
)
from splatseed.cli import main
from splatseed.commands import bench
from splatseed.commands.bench import Machine
from splatseed.commands.tune import sentence
from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.io import load_scene
from splatseed.runtime.tasks import HereTasks
from splatseed.scores import EvalResult, ViewScore
from splatseed.synthetic import make_capture, write_capture

from .planted import result

SFM, GROW, AUTO, MLS = (
    Arm(*words, budget="99")
    for words in (
        ("sfm", "default", 1, "default"), ("sfm", "default", 1, "grow"),
        ("auto", "default", 0, "grow"), ("mls", "default", 0, "default"),
    )
)  # fmt: skip


def _runs(*psnr, repeat=0):
    views = tuple(ViewScore(f"{i}.png", value, 0.8, None, 0.01) for i, value in enumerate(psnr))
    return {repeat: dataclasses.replace(result(0.0), scores=EvalResult(views, num_gaussians=9))}


def test_the_baseline_stays_whatever_it_scores():
    results = {SFM: _runs(20.0), GROW: _runs(23.0), AUTO: _runs(22.0), MLS: _runs(21.0)}
    assert best_arms(results, 2) == (GROW, SFM)
    assert best_arms(results, 4) == (GROW, AUTO, MLS, SFM)


def test_a_verdict_is_paired_by_view():
    """Views differ by decibels, the gain on each by hundredths."""
    base, own = (20.0, 30.0, 25.0), (20.5, 30.6, 25.4)
    said = verdict({SFM: _runs(*base), AUTO: _runs(*own)}, 400)
    assert said.winner == AUTO
    assert said.gain.mean == pytest.approx(0.5)
    assert said.gain.se == pytest.approx(np.std([0.5, 0.6, 0.4], ddof=1) / np.sqrt(3))
    assert verdict({AUTO: _runs(*own)}, 400) is None
    assert verdict({SFM: _runs(*base)}, 400) is None


def test_repeats_that_disagree_are_no_verdict():
    """What a stranger saw: two repeats, -0.26 and +2.04 dB, alike on both views."""
    base = _runs(28.18, 28.1) | _runs(26.48, 26.4, repeat=1)
    own = _runs(27.92, 27.9) | _runs(28.52, 28.4, repeat=1)
    said = verdict({SFM: base, GROW: own}, 400)
    assert said.gain.mean == pytest.approx(0.89, abs=0.03)
    assert said.gain.se > 1.0
    assert said.gain.p > 0.3
    assert "within noise" in sentence(said)


def test_a_round_that_was_stopped_is_judged_by_the_repeats_that_all_have():
    sfm = _runs(24.59) | _runs(25.16, repeat=1)
    said = verdict({SFM: sfm, MLS: _runs(24.95)}, 400)
    assert said.gain.mean == pytest.approx(0.36)
    scores = dict(said.ranking)
    assert scores[MLS] - scores[SFM] == pytest.approx(0.36)


def test_rungs_fit_the_time_as_long_as_they_can():
    cost = lambda rungs: sum(r.steps * r.arms * r.repeats * 0.01 for r in rungs)
    rungs = plan_rungs(15, 600.0, 30_000, cost)
    assert [rung.arms for rung in rungs] == [15, 5, 2]
    assert [rung.repeats for rung in rungs] == [1, 1, 2]
    assert rungs[2].steps == 2 * rungs[1].steps == 4 * rungs[0].steps
    assert 540 < cost(rungs) <= 600
    assert plan_rungs(15, 600.0, 1000, cost)[2].steps <= 1000
    assert plan_rungs(15, 600.0, 400, lambda _: 0.0, 300)[0].steps == 300  # long enough to grow
    with pytest.raises(ParameterError, match="--minutes"):
        plan_rungs(15, 0.1, 1000, cost)


@pytest.mark.parametrize("factor", [1.0, 2.0, 7.0])
def test_growth_reaches_the_budget_in_the_steps_that_it_is_given(factor):
    steps = steps_to_grow(factor)
    assert growth_within(steps) >= factor
    assert steps == 10 or growth_within(steps - 10) < factor
    assert steps_to_grow(1e6) <= 300  # a longer run has no more rounds


@pytest.fixture(scope="module")
def scene_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("made") / "my room"
    return write_capture(make_capture(0, num_views=18, width=64, height=48), path)


def test_the_validation_scene_has_no_test_view(scene_path, tmp_path):
    made = load_scene(make_validation_scene(scene_path, tmp_path / "scene"))
    train, test = load_scene(scene_path).split(8)
    assert {image.name for image in made.images} == {image.name for image in train}
    assert not {image.name for image in made.images} & {image.name for image in test}
    assert len(made.split(8)[1]) == 2
    assert set(made.tracks.image_ids) <= {image.image_id for image in made.images}
    path = write_capture(make_capture(0, num_views=3, width=64, height=48), tmp_path / "room")
    with pytest.raises(SceneNotFoundError, match="hold some of them out"):
        make_validation_scene(path, tmp_path / "too few")


@pytest.fixture
def here(monkeypatch):
    """Runs that are done in this process, until so many are; and how many were."""
    state = {"done": 0, "most": 99}

    class Some(HereTasks):
        def run(self, function, calls, report=None):
            allowed = calls[: state["most"] - state["done"]]
            for ended in super().run(function, allowed, report):
                yield ended
                state["done"] += 1
            if len(allowed) < len(calls):
                raise KeyboardInterrupt

    @contextmanager
    def machine(options, backend):
        yield Machine("cpu", 1, 1, Some())

    monkeypatch.setattr(bench, "open_machine", machine)
    monkeypatch.setattr(tuning, "LEAST_STEPS", 4)
    return state


def test_too_little_time_is_refused_before_anything_begins(scene_path, tmp_path, here, splatseed):
    run = splatseed("tune", scene_path, "--methods", "auto")
    assert (run.code, "sfm among --methods" in run.err) == (2, True)
    run = splatseed("tune", scene_path, "--minutes", "0.01", "-o", tmp_path / "tuned")
    assert (run.code, run.out) == (2, "")
    least = re.search(r"expected --minutes (\d+) or more.*found --minutes 0\.01\.", run.err)
    assert int(least[1]) >= 1
    assert not list(tmp_path.iterdir())


def test_no_arm_has_more_than_growth_can_reach(scene_path, tmp_path, here, splatseed):
    here["most"] = 0
    words = ("--minutes", "999", "--budget", "99999", "-o", tmp_path / "tuned")
    out = splatseed("tune", scene_path, *words).out
    points = len(load_scene(tmp_path / "tuned" / "scene").points)
    most = int(points * growth_within(7000))
    assert f"All arms have {most:,} Gaussians at most" in out


def test_it_names_the_winner_and_goes_on_where_it_was_stopped(
    scene_path, tmp_path, here, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    test = load_scene(scene_path).split(8)[1]
    for image in test:  # whoever opens one fails
        (scene_path / "images" / image.name).write_bytes(b"not a photograph")
    words = ["tune", str(scene_path), "--minutes", "60", "--methods", "sfm", "mls",
             "--strategies", "default", "--budget", "70", "--max-steps", "32"]  # fmt: skip
    here["most"] = 1
    with pytest.raises(SystemExit):
        main(words)
    assert "epeat the command to continue" in capsys.readouterr().out
    here["most"] = 3  # one run of the second round
    with pytest.raises(SystemExit):
        main(words)
    assert "Stopped before the last run" in capsys.readouterr().out
    here["most"] = 99
    main(words)
    out = capsys.readouterr().out
    folder = tmp_path / "tune_my room"
    rungs = [Rung(**each) for each in json.loads((folder / "tune.json").read_text())["rungs"]]
    assert [rung.arms for rung in rungs] == [2, 2, 2]
    assert here["done"] == 2 + 2 + 4
    assert "splatseed train" in out
    assert "--budget 70 --max-steps 32" in out
    main(words)
    assert here["done"] == 8  # nothing is done twice
    other = shutil.copytree(scene_path, tmp_path / "other" / scene_path.name)
    for others in ([*words, "--budget", "80"], ["tune", str(other), *words[2:]]):
        with pytest.raises(SystemExit):
            main(others)
        assert "was begun with" in capsys.readouterr().err
