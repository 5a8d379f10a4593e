"""``splatseed train --config`` and ``info --json``."""

from __future__ import annotations

import json

import pytest

from splatseed.commands.options import known_options
from splatseed.commands.train import Options
from splatseed.commands.train.config import with_config
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError


@pytest.fixture(scope="module")
def known():
    return known_options(Options)


@pytest.fixture
def toml(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text('scene = "room"\nmax_steps = 7\nopacity_reset = true\nseeds = "scene"\n')
    return path


def test_a_file_gives_options_and_the_command_line_wins(toml, known):
    words = with_config(["-o", "out", "--config", str(toml)], known)
    assert words == ["room", "--max-steps", "7", "--opacity-reset", "--seeds", "scene", "-o", "out"]
    words = with_config(
        ["mine", f"--config={toml}", "--max-steps=9", "--no-opacity-reset", "-o", "out"], known
    )
    assert words == ["--seeds", "scene", "mine", "--max-steps=9", "--no-opacity-reset", "-o", "out"]


def test_without_a_file_nothing_changes(known):
    assert with_config(["room", "-o", "out"], known) == ["room", "-o", "out"]


@pytest.mark.parametrize(
    ("content", "error", "said"),
    [
        ("max_stepz = 3", SceneFormatError, "Did you mean max_steps"),
        ("max_steps = [1]", SceneFormatError, "max_steps in .* to be a number"),
        ("max_steps 3", SceneFormatError, "max_steps = 7000"),
    ],
)
def test_what_is_no_option_is_told(content, error, said, tmp_path, known):
    (tmp_path / "run.toml").write_text(content)
    with pytest.raises(error, match=said):
        with_config(["--config", str(tmp_path / "run.toml")], known)


def test_a_file_that_is_not_there_is_told(tmp_path, known):
    with pytest.raises(SceneNotFoundError):
        with_config(["--config", str(tmp_path / "none.toml")], known)
    with pytest.raises(ParameterError, match="after --config"):
        with_config(["room", "--config"], known)


def test_a_runs_config_trains_the_same_run_again(room, splatseed, tmp_path):
    pytest.importorskip("torch", reason="training needs PyTorch")
    pytest.importorskip("gsplat", reason="training needs gsplat's strategies")
    (tmp_path / "run.toml").write_text(
        f'scene = "{room}"\nmax_steps = 3\ndata_factor = 2\nseeds = "scene"\nstrategy = "none"\n'
    )
    first = splatseed("train", "--config", tmp_path / "run.toml", "-o", tmp_path / "a")
    assert first.code == 0, first
    again = splatseed("train", "--config", tmp_path / "a/config.json", "-o", tmp_path / "b")
    assert again.code == 0, again
    a, b = ((tmp_path / each / "point_cloud.ply").read_bytes() for each in "ab")
    assert a == b


def test_info_for_scripts_is_json_alone(room, splatseed):
    run = splatseed("info", room, "--json")
    assert (run.code, run.err) == (0, "")
    facts = json.loads(run.out)
    assert facts["images"] == 12
    assert facts["train_images"] + facts["test_images"] == 12
    assert facts["points"]["num_points"] > 400
    assert len(facts["points"]["spacing"]) == 5
    assert isinstance(facts["problems"], list)
