"""How long a run takes: the arithmetic, not the clock."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from splatseed.camera import Intrinsics
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene
from splatseed.seeding.budget import points_within
from splatseed.training.duration import (
    HOUR,
    RunSpeed,
    mean_gaussians,
    options_for_an_hour,
    planned_seconds,
    seconds_left,
    step_seconds,
)
from splatseed.training.settings import TrainSettings
from splatseed.training.traits import FULL_AT

GROW = TrainSettings(strategy="auto", max_steps=10_000, cap_max=400_000, data_factor=3)
EARLY = RunSpeed(100, 0.5, 20_000, 1344 * 1008)


@pytest.mark.parametrize(
    ("strategy", "stop", "last"), [("grow", FULL_AT, 400_000), ("mcmc", 25 / 30, 400_000),
                                   ("default", 0.5, 20_000 * 3**0.98)],
)  # fmt: skip
def test_the_mean_number_is_that_of_its_steps(strategy, stop, last):
    """A sum over the steps: linear until growth ends, the last number from there on."""
    settings = replace(GROW, strategy=strategy)
    counts = [
        20_000 + (last - 20_000) * min(1.0, (step - 100) / (stop * 10_000 - 100))
        for step in range(100, 10_000)
    ]
    assert mean_gaussians(settings, EARLY) == pytest.approx(sum(counts) / len(counts), rel=1e-3)
    assert mean_gaussians(replace(settings, strategy="none"), EARLY) == 20_000
    assert mean_gaussians(settings, EARLY._replace(step=9_000, gaussians=9)) == 9


def test_later_steps_are_slower_and_the_machine_is_the_runs_own():
    left = seconds_left(GROW, EARLY)
    assert left > 1.3 * 9_900 * EARLY.seconds
    assert seconds_left(GROW, EARLY._replace(seconds=1.0)) == pytest.approx(2 * left)
    assert seconds_left(GROW, EARLY._replace(step=10_000)) == 0
    steady = replace(GROW, strategy="none")
    assert seconds_left(steady, EARLY) == pytest.approx(9_900 * 0.5)


def test_a_run_that_has_not_begun_is_estimated_from_its_seeds():
    settings, pixels = replace(GROW, strategy="none"), 400_000
    planned = planned_seconds(settings, 50_000, pixels, 2)
    assert planned == pytest.approx(10_000 * step_seconds("cpu", 50_000, pixels))
    one = planned_seconds(settings, 50_000, pixels, 1)
    assert one == pytest.approx(2 * planned)
    grown = planned_seconds(GROW, 50_000, pixels, 2)
    assert planned < grown < 10_000 * step_seconds("cpu", 400_000, pixels)


@pytest.mark.parametrize("per_pixel", [True, False])
@pytest.mark.parametrize(("seconds", "steps"), [(0.3, 10_000), (2.4, 30_000), (40.0, 30_000)])
def test_what_is_advised_takes_about_an_hour(seconds, steps, per_pixel):
    settings, now = replace(GROW, max_steps=steps), EARLY._replace(seconds=seconds)
    text = options_for_an_hour(settings, now, 4032, per_pixel=per_pixel)
    options = {name: int(value) for name, value in re.findall(r"`(\w+)=(\d+)`", text)}
    factor = -(-4032 // options["long_side"])
    assert factor >= 3
    smaller = (3 / factor) ** 2
    pixels, cap = now.pixels * smaller, 400_000 * (smaller if per_pixel else 1)
    chosen = replace(settings, max_steps=options.get("max_steps", steps), cap_max=round(cap))
    count = min(20_000, round(cap))
    slower = seconds / step_seconds("cpu", 20_000, now.pixels)
    each = slower * step_seconds("cpu", count, pixels)
    expected = seconds_left(chosen, RunSpeed(0, each, count, round(pixels)))
    assert HOUR / 3 < expected < 1.05 * HOUR  # and no less than need be


@pytest.mark.parametrize(("side", "factor"), [(1600, 1), (1601, 2), (1920, 2), (4032, 3)])
def test_photographs_are_1600_pixels_a_side_at_most_unless_asked(side, factor, rng):
    lens = Intrinsics(1, "PINHOLE", side, side // 2, (900.0, 900.0, side / 2, side / 4))
    image = Image("a.jpg", 1, lens, rng.normal(size=4), rng.normal(size=3))
    findings = []
    settings = TrainSettings().with_data_factor((image,), findings.append)
    assert (settings.data_factor, len(findings)) == (factor, factor > 1)
    assert TrainSettings(data_factor=1).with_data_factor((image,), findings.append).data_factor == 1
    if factor > 1:
        assert f"{side // factor:,} x" in findings[0].text
    # Budgets in rho count pixels at that size, in whatever verb.
    scene = Scene(PointCloud.empty(), (image,))
    assert points_within(scene, "1rho") == (side // factor) * (side // 2 // factor)
