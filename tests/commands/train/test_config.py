"""``splatseed train --config``."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatseed.commands.train import parse
from splatseed.errors import SceneFormatError, SceneNotFoundError


@pytest.fixture
def toml(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text('scene = "room"\nmax_steps = 7\nopacity_reset = true\nseeds = "scene"\n')
    return path


def test_a_file_gives_options_and_the_command_line_wins(toml):
    options = parse(["-o", "out", "--config", str(toml)])
    assert (options.scene, options.output) == (Path("room"), Path("out"))
    assert (options.training.max_steps, options.training.opacity_reset) == (7, True)
    assert options.seeds == "scene"
    options = parse(["mine", f"--config={toml}", "--max-steps=9", "-o", "out"])
    assert (options.scene, options.training.max_steps) == (Path("mine"), 9)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("max_stepz = 3", "Did you mean max_steps"),
        ("max_steps = [1]", "max_steps"),
        ("max_steps = true", "max_steps"),
        ("opacity_reset = 1", "opacity_reset"),
        ('strategy = "defalt"', "strategy"),
        ("max_steps 3", r"run\.toml"),
    ],
)
def test_what_is_no_option_is_told(content, said, tmp_path):
    (tmp_path / "run.toml").write_text(content)
    with pytest.raises(SceneFormatError, match=said):
        parse(["--config", str(tmp_path / "run.toml")])


def test_a_file_that_is_not_there_is_told(tmp_path):
    with pytest.raises(SceneNotFoundError):
        parse(["--config", str(tmp_path / "none.toml")])


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
