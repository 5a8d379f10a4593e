"""Numbers that make no sense: each is refused before anything is printed, by the option's name."""

from __future__ import annotations

import contextlib
import io
import re
from importlib import import_module

import pytest
import tyro

pytest.importorskip("torch", reason="some verbs import PyTorch")

from splatseed.commands.spelling import in_options
from splatseed.commands.upsample.command import full_options

NUMBER = re.compile(r"(--[\w.-]+) (INT|FLOAT)\b")
ALL_CORES = {("sfm", "--threads"), ("undistort", "--threads")}
VERBS = {
    "info": [],
    "upsample": ["--method", "mls"],
    "train": [],
    "evaluate": ["--scene", "{scene}"],
    "flight": [],
    "export": [],
    "depth": ["--stereo"],
    "sfm": [],
    "undistort": [],
    "tune": [],
    "bench": ["--preset", "quick"],
}
OUTPUTS = {"flight": "out.mp4", "export": "out.splat"}


def numbers_of(verb: str) -> dict[str, str]:
    """The options of a verb that take one number, with its kind."""
    kind = full_options() if verb == "upsample" else None
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
        tyro.cli(kind or import_module(f"splatseed.commands.{verb}").Options, args=["--help"])
    return dict(NUMBER.findall(re.sub(r"\x1b\[[0-9;]*m", "", shown.getvalue())))


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A file that only looks like Gaussians: none of these runs gets as far as to read it."""
    path = tmp_path_factory.mktemp("model") / "point_cloud.ply"
    path.write_bytes(b"ply\n")
    return path


@pytest.mark.parametrize("verb", VERBS)
def test_numbers_without_sense_are_refused_at_once(verb, room, model, tmp_path, splatseed):
    options = numbers_of(verb)
    assert options or verb in {"export", "info"}, "the help is read wrongly"
    thing = {"sfm": room / "images", "bench": None}.get(verb, room)
    thing = model if verb in {"evaluate", "flight", "export"} else thing
    output = () if verb in {"info", "evaluate"} else ("-o", tmp_path / OUTPUTS.get(verb, "out"))
    for option, kind in options.items():
        for value in ("-1",) if kind == "INT" else ("-1", "nan"):
            if (verb, option) in ALL_CORES:
                continue
            words = [word.format(scene=room) for word in VERBS[verb]]
            run = splatseed(verb, *([] if thing is None else [thing]), *words, *output,
                            f"{option}={value}")  # fmt: skip
            told = f"{verb} {option}={value}: {run.err}"
            assert run.code == 2, told
            assert option in run.err or "--depth DIR" in run.err, told
            assert not run.out, told
            assert not list(tmp_path.iterdir()), told


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("bench", "--preset", "quick", "--repeats", 0), "--repeats of 1 or more; found 0"),
        (("bench", "--preset", "quick", "--long-side", 0), "--long-side of 1 or more; found 0"),
        (("upsample", "{room}", "--jobs", 0), "--jobs of 1 or more; found 0"),
        (("upsample", "{room}", "--tile-points", 0), "--tile-points of 1 or more; found 0"),
        (("upsample", "{room}", "--cover", 0, "--method", "mls"), "--cover of 1 or more; found 0"),
        (("upsample", "{room}", "--auto.grid", 0), "--auto.grid from 1 to 32; found 0"),
        (("upsample", "{room}", "--num-points", "500k"), "Did you mean 500000?"),
        (("upsample", "{room}", "--max-steps", 70), "--max-steps without -o and --method"),
        (("upsample", "{room}", "--mls.k", "abc"), "splatseed upsample --method mls --help"),
        (("upsample", "{room}", "--mls.kk", 3), "splatseed upsample --method mls --help"),
        (("upsample", "{room}", "--budget", "1e-9rho"), "found 1e-9rho, which of 10,800 pixels is"),
        (("train", "{room}", "--data-factor", 1000), "--data-factor, or a larger --long-side"),
        (("train", "{room}", "--data-factor", 1000, "--seeds", "scene"), "view_000.png to have at"),
        (("depth", "{room}", "--stereo", "--max-size", 5), "--max-size of 32 or more; found 5"),
        (("train", "{room}", "--cap-max", "1.5M"), "Did you mean 1500000?"),
        (("upsample", "{room}", "--cover", 8), "expected --auto.cell for method auto"),
        (("upsample", "{room}", "--method", "mls", "--ratio", "1e9"), "1e+09 for 464 originals"),
        (("upsample", "{room}", "--address", "auto"), "--executor ray with --address"),
        (("depth", "{room}", "--stereo", "--grid", 99), "--grid from 1 to 32; found 99"),
        (("train", "{room}", "--budget", 1), "--budget of 2 Gaussians or more; found 1"),
        (("train", "{room}", "--long-side", 5), "or a larger --long-side"),
        (("train", "{room}", "--view-port", 70000, "--view"), "--view-port from 0 to 65535"),
        (("train", "{room}", "--view-port", 9000), "--view with --view-port"),
        (("sfm", "{room}/images", "--frames", 5), "a video with --frames"),
        (("sfm", "{room}/images", "--max-image-size", 0), "expected --max-image-size between"),
        (("sfm", "{room}/images", "--camera-model", "FOO"), "expected --camera-model to be one of"),
        (
            ("sfm", "{room}/images", "--poses-from", "{room}", "--camera-model", "PINHOLE"),
            "the lens from --poses-from, without options of its own; found --camera-model",
        ),
    ],
)
def test_the_error_names_what_was_typed(words, says, room, tmp_path, splatseed):
    if "--view" in words:
        pytest.importorskip("viser", reason="the viewer needs viser (extra view)")
    if words[0] == "sfm":
        pytest.importorskip("pycolmap", reason="sfm needs pycolmap")
    words = [str(word).format(room=room) for word in words]
    run = splatseed(*words, "-o", tmp_path / "out")
    assert run.code == 2
    assert says in run.err
    assert not run.out
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("value", "says"), [(0, "--max-steps of 1 or more; found 0"), ("abc", "as a whole number")]
)
def test_a_bad_value_in_a_question_for_advice_is_told(value, says, room, splatseed):
    assert says in splatseed("upsample", room, "--max-steps", value).err
    assert says in splatseed("info", room, "--max-steps", value).err


@pytest.mark.parametrize("word", ["--preview", "--verify", "--seed=1", "--copy-images"])
def test_an_option_of_upsampling_asks_for_the_output(word, room, splatseed):
    run = splatseed("upsample", room, word)
    assert run.code == 2
    assert f"expected -o OUT, the scene folder to write, with {word.partition('=')[0]}" in run.err
    assert "unrecognized" in splatseed("upsample", room, "--nonsense").err
    for slip, meant in (("--ouput", "--output"), ("--max-step", "--max-steps")):
        assert f"Did you mean {meant}?" in splatseed("upsample", room, slip, "5").err


@pytest.mark.parametrize(
    ("words", "idle"),
    [
        (("--strategy", "mcmc", "--opacity-reset"), "--opacity-reset has no effect with strategy"),
        (("--strategy", "default", "--placing", "none"), "--placing has no effect with strategy"),
        (("--strategy", "default", "--opacity-reset"), ""),
    ],
)
def test_settings_of_another_strategy_are_told(words, idle, room, tmp_path, splatseed):
    pytest.importorskip("gsplat", reason="training needs gsplat's strategies")
    short = ("--max-steps", 1, "--long-side", 60, "--seeds", "scene")
    run = splatseed("train", room, *words, *short, "-o", tmp_path / "run")
    assert run.code == 0, run.err
    assert ("has no effect" in run.out) == bool(idle)
    assert idle in run.out


def test_only_names_of_options_are_spelled_otherwise():
    said = "expected sparse/0 in splatseed.json of mls.disc_radius; found max_steps. See train.k."
    spelled = "expected sparse/0 in splatseed.json of --mls.disc-radius; found max_steps. See"
    assert in_options(said, "upsample").startswith(spelled)
    assert in_options("expected seed between 0 and 1", "sfm") == "expected --seed between 0 and 1"
    assert in_options("expected scene of mine", "sfm") == "expected scene of mine"
