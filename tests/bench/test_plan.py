"""Plans: what is in them, what files say, which runs they are, and when two runs are the same."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st

from splatseed.bench.plan import (
    SFM,
    Arm,
    Plan,
    RunResult,
    RunSpec,
    describe_budget,
    fair_budget,
    plan_runs,
)
from splatseed.bench.plan_file import plan_text, read_plan
from splatseed.bench.scenes import DEMO, PlannedScene, SceneFacts
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.scores import CurvePoint, EvalResult, ViewScore
from splatseed.training.settings import TrainSettings

from .planted import surveyed

PAPER_PLAN = Path(__file__).parents[2] / "benchmarks" / "paper" / "small.toml"
TEXTS = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=20)
RATIOS = st.floats(1, 1e6, exclude_min=True)


def _written(plan, tmp_path):
    path = tmp_path / "plan.toml"
    path.write_text(plan_text(plan), "utf-8")
    return read_plan(path)


def _some(strategy):
    return st.lists(strategy, min_size=1, max_size=3, unique=True).map(tuple)


PLANS = st.builds(
    Plan,
    methods=_some(st.sampled_from(["sfm", "linear", "cloud+auto"])),
    ratios=_some(RATIOS),
    training=st.builds(TrainSettings, cap_max=st.none() | st.integers(2, 10**9)),
    lpips=st.booleans(),
    scenes=st.lists(
        st.builds(
            PlannedScene,
            path=TEXTS.map(lambda text: f"/{text}"),
            name=TEXTS,
            images=st.just("") | TEXTS,
            depth=st.just("") | TEXTS.map(lambda text: f"/{text}"),
            cloud=st.just("") | TEXTS.map(lambda text: f"/{text}"),
        ),
        max_size=3,
        unique_by=lambda scene: scene.name,
    ).map(tuple),
    parameters=st.just({}) | st.just({"mls": {"k": 12}, "depth": {"align": False}}),
)


@settings(max_examples=60, deadline=None)
@given(PLANS)
def test_a_plan_survives_its_file(tmp_path_factory, plan):
    again = _written(plan, tmp_path_factory.mktemp("plan"))
    assert dataclasses.replace(again, scenes=()) == dataclasses.replace(plan, scenes=())
    for a, b in zip(again.scenes, plan.scenes, strict=True):
        assert (a.name, a.images, bool(a.depth)) == (b.name, b.images, bool(b.depth))
        assert (Path(a.path), Path(a.depth)) == (Path(b.path), Path(b.depth))
        assert (bool(a.cloud), Path(a.cloud)) == (bool(b.cloud), Path(b.cloud))


def test_paths_in_a_file_are_beside_it(tmp_path):
    (tmp_path / "plan.toml").write_text(
        '[[scenes]]\npath = "garden"\ndepth = "d"\n[[scenes]]\npath = "demo:"\n'
    )
    garden, demo = read_plan(tmp_path / "plan.toml").scenes
    assert (garden.path, garden.depth) == (str(tmp_path / "garden"), str(tmp_path / "d"))
    assert (garden.label, demo.label, demo.path) == ("garden", "demo", DEMO)


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("repeats = ", "TOML"),
        ("reapeats = 3", "reapeats"),
        ('repeats = "3"', "repeats"),
        ("repeats = 0", "repeats"),
        ("ratios = [true]", "ratios"),
        ("ratios = [0.5]", "ratios"),
        ("ratios = []", "ratios"),
        ("ratios = [4, 4.0]", "ratios"),
        ('methods = ["sfm", "magic"]', "magic"),
        ('methods = "sfm"', "methods"),
        ("ratios = []\nbudgets = ['many']", "many"),
        ("ratios = []\nbudgets = [1]", "budgets"),
        ("ratios = []\nbudgets = [100, '100']", "100 twice"),
        ("ratios = []\nbudgets = [100]\ncap_max = 9", "both"),
        ("ratios = []\nbudgets = [0.25]", "Did you mean 0.25rho?"),
        ("long_side = 400\ndata_factor = 2", "both"),
        ('strategies = ["mcmcm"]', "mcmcm"),
        ("max_steps = 0", "max_steps"),
        ("scenes = [1]", "scenes"),
        ("[[scenes]]\nname = 'x'", "path"),
        ("[[scenes]]\npath = 'x'\nfolder = 'y'", "scenes.folder"),
        ("[[scenes]]\npath = 'a/x'\n[[scenes]]\npath = 'b/x'", "x twice"),
        ("[parameters.mls]\nneighbours = 3", "neighbours"),
        ("[parameters.mls]\nk = -3", "mls.k"),
        ("[parameters]\nmls = 3", "parameters.mls"),
        ("[parameters.magic]\nk = 1", "magic"),
    ],
)
def test_bad_files_are_refused_by_key(tmp_path, text, key):
    (tmp_path / "plan.toml").write_text(text)
    with pytest.raises(SceneFormatError, match=re.escape(key)) as error:
        read_plan(tmp_path / "plan.toml")
    assert "plan.toml" in str(error.value)
    with pytest.raises(SceneNotFoundError, match=r"none\.toml"):
        read_plan(tmp_path / "none.toml")


def test_arms_are_all_combinations_and_the_original_cloud_once():
    plan = Plan(methods=("linear", "sfm", "random"), ratios=(4, 8), profiles=("default", "paper"))
    assert [arm.label for arm in plan.arms("none")] == [
        "sfm", "linear 4x", "linear 8x", "linear 4x (paper)", "linear 8x (paper)",
        "random 4x", "random 8x",  # whose profiles are the same
    ]  # fmt: skip
    assert plan.arms("mcmc")[0] == Arm(SFM, "default", 1, "mcmc")


def test_runs_repeat_only_when_all_have_been_run(small_plan, room_path):
    plan = dataclasses.replace(small_plan, strategies=("none", "default"), repeats=3)
    facts = surveyed(room_path)
    runs = plan_runs(plan, [facts, dataclasses.replace(facts, name="other")], "cpu")
    assert [run.repeat for run in runs] == [0] * 8 + [1] * 8 + [2] * 8
    assert len({run.key for run in runs}) == 24
    assert runs[0].arm.method == SFM
    assert {run.settings.seed for run in runs} == {0, 1, 2}


def test_depth_needs_maps_and_never_sees_the_test_photographs(small_plan, room_path, tmp_path):
    plan = dataclasses.replace(small_plan, methods=("sfm", "depth"), repeats=1)
    without = plan_runs(plan, [surveyed(room_path)], "cpu")
    assert [run.arm.method for run in without] == [SFM]
    facts = surveyed(room_path, with_depth=True)
    assert facts.depth == str(room_path)
    _, depth = plan_runs(plan, [facts], "cpu")
    assert depth.parameters == {"test_every": plan.training.test_every}
    assert depth.scene.depth_digest == facts.depth_digest
    with pytest.raises(SceneNotFoundError, match="folder of depth maps"):
        surveyed(room_path, depth=tmp_path / "none", with_depth=True)


def test_a_scan_is_part_of_what_its_methods_depend_on(small_plan, room_path, tmp_path):
    methods = ("sfm", "cloud", "cloud+cover")
    scan = tmp_path / "scan.xyz"
    scan.write_text("1 2 3\n" * 9)
    plan = dataclasses.replace(small_plan, methods=methods, repeats=1)
    (plain,) = plan_runs(plan, [surveyed(room_path)], "cpu")
    facts = surveyed(room_path, cloud=scan)
    sfm, *others = runs = plan_runs(plan, [facts], "cpu")
    assert sfm.key == plain.key
    assert {run.scene.cloud for run in others} == {str(scan)}
    every = plan.training.test_every
    assert [run.parameters for run in others] == [
        {"test_every": every}, {"test_every": every, "cloud.test_every": every},
    ]  # fmt: skip
    scan.write_text("1 2 4\n" * 9)
    changed = plan_runs(plan, [surveyed(room_path, cloud=scan)], "cpu")
    assert [run.key in {old.key for old in runs} for run in changed] == [True, False, False]
    (tmp_path / "scan.laz").write_bytes(b"no scan")
    with pytest.raises(SceneFormatError, match=r"scan\.laz"):
        surveyed(room_path, cloud=tmp_path / "scan.laz")


def test_a_scene_is_known_by_its_content(room_path, own_room):
    before = surveyed(room_path, with_depth=True)
    copy = surveyed(own_room, with_depth=True)
    assert copy.path != before.path
    assert (copy.digest, copy.depth_digest) == (before.digest, before.depth_digest)
    photograph = next((own_room / "images").iterdir())
    photograph.write_bytes(photograph.read_bytes() + b"\0")
    assert surveyed(own_room).digest != before.digest
    depth = sorted((own_room / "depths").glob("*.png"))
    depth[0].write_bytes(depth[1].read_bytes())
    after = surveyed(own_room, with_depth=True)
    assert after.depth_digest != before.depth_digest


def test_what_would_fail_every_run_is_found_before(own_room):
    (own_room / "images").rename(own_room / "images_4")
    (own_room / "images").mkdir()
    assert surveyed(own_room, images="images_4").num_images == 9
    for number in range(3, 8):
        (own_room / "images_4" / f"view_{number:03}.png").unlink()
    with pytest.raises(SceneNotFoundError, match=r"view_003\.png"):
        surveyed(own_room, images="images_4")
    for each in (own_room / "sparse" / "0").iterdir():
        if not each.name.startswith("points3D"):
            each.unlink()
    with pytest.raises(SceneNotFoundError, match="photographs in"):
        surveyed(own_room)


def _facts(name, points, images=20, pixels=800 * 600):
    return SceneFacts(name, name, digest=name, num_points=points, num_images=images, pixels=pixels,
                      long_side=800)  # fmt: skip


FERN = _facts("fern", 6000)
BONSAI = _facts("bonsai", 110_000, 292, 800 * 533)


def test_a_budget_is_the_same_number_for_every_arm_of_a_scene():
    plan = Plan(
        methods=("sfm", "mls", "auto"), ratios=(), budgets=("0.25RHO", 20000.0),
        strategies=("default", "grow"), repeats=1, long_side=400,
    )  # fmt: skip
    assert plan.budgets == ("0.25rho", "20000")
    assert Plan(ratios=(), budgets=("50k", "0.5M", " 1 rho")).budgets == ("50000", "500000", "1rho")
    runs = plan_runs(plan, [FERN, BONSAI], "cpu")
    assert len(runs) == len({run.key for run in runs}) == 2 * 3 * 2 * 2
    numbers = {(run.scene.name, run.arm.budget): run.settings.cap for run in runs}
    assert numbers == {
        ("fern", "0.25rho"): 30_000, ("fern", "20000"): 20_000,
        ("bonsai", "0.25rho"): 26_600, ("bonsai", "20000"): 20_000,
    }  # fmt: skip
    assert {run.training.data_factor for run in runs} == {2}  # 533 rows become 266
    seeds = {(r.arm.strategy, r.max_seeds) for r in runs if r.scene.name == "fern"}
    assert seeds == {("default", 21_000), ("default", 14_000), ("grow", 30_000), ("grow", 20_000)}


def test_a_fair_budget_thins_no_seeds_that_a_ratio_asks_for():
    budget = fair_budget((4, 8))
    assert (budget, describe_budget(budget)) == (
        "0.25rho or 12x",
        "0.25 per pixel of a photograph in training or 12 per point of the scene (the larger)",
    )  # fmt: skip
    plan = Plan(ratios=(4, 8), budgets=(budget,), repeats=1, long_side=800)
    runs = plan_runs(plan, [FERN, BONSAI], "cpu")
    caps = {run.scene.name: run.training.cap_max for run in runs}
    assert caps == {"fern": 120_000, "bonsai": 1_320_000}  # by pixels, and by points
    assert all(run.max_seeds >= run.arm.ratio * run.scene.num_points for run in runs)
    assert Plan(budgets=(" 12.0X or 50k",)).budgets == ("12x or 50000",)
    with pytest.raises(ParameterError, match="found 'xx'"):
        Plan(budgets=("0.25rho or xx",))


ARM = Arm("mls", "default", 8, "none")
SPEC = RunSpec(
    _facts("room", 10_000, 80), ARM, repeat=0, training=TrainSettings(max_steps=100, backend="cpu"),
    parameters={"k": 12}, version="1",
)  # fmt: skip


def test_specs_and_results_survive_json():
    assert RunSpec.from_dict(json.loads(json.dumps(SPEC.to_dict()))) == SPEC
    views = (ViewScore("a.png", math.inf, 0.8, None, 0.01, 22.0, 0.9),)
    scores = EvalResult(views, num_gaussians=8, model_bytes=1888)
    result = RunResult(scores, (CurvePoint(5, 0.1, 20.0, 7, 0.7),), 7, 0.2, 1.5, 10**9, "CPU")
    assert RunResult.from_dict(json.loads(json.dumps(result.to_dict()))) == result
    older = result.to_dict()
    for name in ("flip", "cc_psnr"):  # were not measured
        del older["scores"][name], older["scores"]["per_image"][0][name]
    assert RunResult.from_dict(older) == result


def test_a_key_is_of_all_but_where_a_scene_lies_and_how_a_ratio_is_written():
    there = dataclasses.replace(SPEC.scene, path="/a", depth="/b", images="images_4", cloud="/c")
    assert dataclasses.replace(SPEC, scene=there).key == SPEC.key
    assert dataclasses.replace(SPEC, arm=Arm("mls", "default", 8.0, "none")).key == SPEC.key
    scenes = [
        dataclasses.replace(SPEC.scene, **{name: "x"})
        for name in ("name", "digest", "depth_digest", "cloud_digest")
    ]
    for change in (
        {"repeat": 1}, {"version": "2"}, {"parameters": {"k": 13}},
        {"arm": Arm("mls", "default", 8, "mcmc")},
        {"training": dataclasses.replace(SPEC.training, data_factor=2)},
        *({"scene": scene} for scene in scenes),
    ):  # fmt: skip
        assert dataclasses.replace(SPEC, **change).key != SPEC.key


def test_budgets_leave_uncapped_strategies_alone():
    plan = read_plan(PAPER_PLAN, Path("DIR"))
    free, equal = map(plan.arms, plan.strategies)
    assert {arm.budget for arm in free} == {""}
    assert {arm.budget for arm in equal} == set(plan.budgets)
    assert len(free) == len(equal) == 1 + 5 * 3 * 2 + 3  # sfm, methods, and random's one profile
    with pytest.raises(ParameterError, match="at least one of ratios"):
        dataclasses.replace(plan, ratios=())
    with pytest.raises(ParameterError, match="test views to compare by"):
        dataclasses.replace(plan, training=TrainSettings(test_every=0))
