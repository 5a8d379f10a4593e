"""Words that make no sense: exit code 2 at once, nothing written, and the option is named."""

from __future__ import annotations

import re
import subprocess
from importlib import import_module
from importlib.metadata import version

import pytest

pytest.importorskip("torch", reason="some verbs import PyTorch")

from splatseed.cli import COMPLETION, VERBS

from ..command_line import parser_of

OUT = ("-o", "OUT")
LIFT = ("upsample", "ROOM", *OUT, "--method", "depth")
MLS = ("upsample", "ROOM", *OUT, "--method", "mls")
TRAIN = ("train", "ROOM", *OUT)
DEPTH = ("depth", "ROOM", *OUT)
SFM = ("sfm", "ROOM/images", *OUT)
QUICK = ("bench", "--preset", "quick", *OUT)
EVALUATE = ("evaluate", "model.ply", "--scene", "ROOM")

WORDS = [
    (("--no-such-verb",), "--no-such-verb"),
    (("upsmaple",), "Did you mean upsample?"),
    (("Info",), "Did you mean info?"),
    (("--verison",), "Did you mean --version?"),
    (("info",), "PATH"),
    (("info", "nowhere"), "nowhere"),
    (("info", "nowhere", "--bogus"), "--bogus"),
    (("info", "ROOM", "--max-steps", "0"), "--max-steps"),
    (("info", "ROOM", "b", "c"), "b, c"),
    (("info", "ROOM", "--picture", "a.png"), "--depth DIR"),
    (("info", "ROOM", "--depth-kind", "ray"), "--depth DIR"),
    (("info", "ROOM", "--depth-scale", "5"), "--depth DIR"),
    (("info", "ROOM", "--depth", "gone"), "gone"),
    (("info", "ROOM", "--depth", "ROOM", "--depth-scale", "0"), "scale"),
    (("info", "ROOM", "--depth", "ROOM", "--depth-kind", "up"), "--depth-kind"),
    (("upsample",), "-o"),
    (("upsample", "ROOM"), "-o"),
    (("upsample", "nowhere", *OUT), "nowhere"),
    (("upsample", "ROOM", "-o", "more.ply"), "-o more"),
    (("upsample", "ROOM", *OUT, "--address", "auto"), "--executor ray"),
    (("upsample", "ROOM", *OUT, "--jobs", "0"), "--jobs"),
    (("upsample", "ROOM", *OUT, "--budget", "1e-9rho"), "1e-9rho"),
    (("upsample", "ROOM", *OUT, "--cover", "8"), "--auto.cell"),
    (("upsample", "ROOM", *OUT, "--auto.grid", "0"), "grid"),
    (("upsample", "ROOM", *OUT, "--method", "magic"), "magic"),
    (("upsample", "ROOM", *OUT, "--profile", "papers"), "papers"),
    (("upsample", "ROOM", *OUT, "--format", "nerf"), "nerf"),
    (("upsample", "ROOM", *OUT, "--ratoi", "4"), "--ratio"),
    ((*MLS, "another"), "another"),
    ((*MLS, "--seed", "-1"), "--seed"),
    ((*MLS, "--mls.k", "2"), "mls.k"),
    ((*MLS, "--mls.k", "two"), "--mls.k"),
    ((*MLS, "--mls.frame", "up"), "--mls.frame"),
    ((*MLS, "--linear.k", "2"), "--linear.k"),
    ((*MLS, "--cover", "0"), "--cover"),
    ((*MLS, "--ratio"), "--ratio"),
    ((*MLS, "--ratio", "0.5"), "ratio"),
    ((*MLS, "--ratio", "nan"), "ratio"),
    ((*MLS, "--ratio", "1e12"), "4,294,967,296"),
    ((*MLS, "--ratio", "many"), "--ratio"),
    ((*MLS, "--num-points", "10"), "found 10"),
    ((*MLS, "--num-points", "500k"), "--num-points"),
    ((*MLS, "--ratio", "2", "--num-points", "5000"), "both"),
    ((*LIFT, "--depth", "nowhere"), "nowhere"),
    ((*LIFT, "--depth-kind", "ray"), "--depth DIR"),
    ((*LIFT, "--depth", "ROOM", "--depth-scale", "0"), "scale"),
    ((*LIFT, "--depth", "ROOM", "--depth.tolerance", "2"), "tolerance"),
    (("train", "ROOM"), "-o"),
    ((*TRAIN, "--max-step", "4"), "--max-steps"),
    ((*TRAIN, "--strategy", "defalt"), "--strategy"),
    ((*TRAIN, "--data-factor", "1000"), "--data-factor"),
    ((*TRAIN, "--long-side", "5"), "--long-side"),
    ((*TRAIN, "--budget", "1"), "--budget"),
    ((*TRAIN, "--budget", "many"), "many"),
    ((*TRAIN, "--config", "nowhere.toml"), "nowhere.toml"),
    ((*TRAIN, "--config"), "--config"),
    ((*EVALUATE, "--data-factor", "0"), "--data-factor"),
    ((*EVALUATE, "--test-every", "1"), "--test-every"),
    ((*EVALUATE, "--backend", "gpu"), "--backend"),
    (("evaluate", "model.ply"), "--scene"),
    (DEPTH, "--stereo"),
    ((*DEPTH, "--stereo", "--model", "some"), "--model"),
    ((*DEPTH, "--stereo", "--max-size", "5"), "--max-size"),
    ((*DEPTH, "--stereo", "--grid", "99"), "--grid"),
    ((*DEPTH, "--stereo", "--depth-kind", "z"), "--depth-kind"),
    ((*DEPTH, "--model", "some", "--colmap"), "--colmap"),
    ((*DEPTH, "--model", "nobody/Depth-Nothing-hf"), "nobody/Depth-Nothing-hf"),
    ((*DEPTH, "--model", "gone.onnx"), "gone.onnx"),
    (("sfm",), "-o"),
    (("sfm", "x", "-o"), "-o"),
    (("sfm", "nowhere", *OUT), "nowhere"),
    ((*SFM, "--frames", "5"), "--frames"),
    ((*SFM, "--device", "abacus"), "abacus"),
    ((*SFM, "--camera-model", "FOO"), "FOO"),
    ((*SFM, "--refine-poses"), "--poses-from"),
    ((*SFM, "--poses-from", "ROOM", "--camera-model", "PINHOLE"), "--camera-model"),
    (("bench", "reprot", "B"), "Did you mean report?"),
    ((*QUICK, "--repeats", "0"), "--repeats"),
    ((*QUICK, "--long-side", "0"), "--long-side"),
    (("demo", "--views", "many"), "--views"),
    (("demo", "--views", "2"), "views"),
    (("demo", "--train-steps", "-1"), "--train-steps"),
]


@pytest.fixture
def refused(room, tmp_path, monkeypatch, splatseed):
    """Checks that words are refused, where ROOM is a scene, and gives what is said."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.ply").write_bytes(b"ply\n")

    def check(*words):
        run = splatseed(*(str(word).replace("ROOM", str(room)) for word in words))
        assert run.code == 2, run
        assert not run.out, run
        assert "Traceback" not in run.err
        assert [path.name for path in tmp_path.iterdir()] == ["model.ply"]
        return " ".join(re.sub("[│╭╮╰╯─]", " ", run.err).split())

    return check


@pytest.mark.parametrize(
    ("words", "named"),
    WORDS,
    ids=lambda each: each if isinstance(each, str) else " ".join(each)[-40:],
)
def test_what_makes_no_sense_is_refused_by_name(words, named, refused):
    if words[0] == "sfm":
        pytest.importorskip("pycolmap", reason="sfm needs pycolmap")
    assert named in refused(*words)


THINGS = {"sfm": ["ROOM/images"], "bench": QUICK[1:], "evaluate": EVALUATE[1:]}
MODELS = {"flight": "out.mp4", "export": "out.splat"}
ALSO = {"upsample": ["--method", "mls"], "depth": ["--stereo"]}
ANY = {("sfm", "--threads")}
"""Where -1 stands for all."""


@pytest.mark.parametrize("verb", sorted({*VERBS} - {"demo", "view"}))
def test_no_number_is_below_its_least(verb, refused):
    kind = import_module(f"splatseed.commands.{verb}").Options
    things = ["model.ply"] if verb in MODELS else THINGS.get(verb, ["ROOM"])
    output = [] if verb in {"info", "evaluate", "bench"} else ["-o", MODELS.get(verb, "OUT")]
    for action in parser_of(kind)._actions:
        option = action.option_strings[-1] if action.option_strings else ""
        values = {"INT": ["-1"], "FLOAT": ["-1", "nan"]}.get(str(action.metavar), [])
        for value in [] if (verb, option) in ANY else values:
            said = refused(verb, *things, *ALSO.get(verb, []), *output, f"{option}={value}")
            field = option.removeprefix("--").replace("-", "_")
            assert option in said or field in said or "--depth DIR" in said, said


def test_the_version(splatseed):
    assert splatseed("-V").out == f"splatseed {version('splatseed')}\n"


def test_help_of_a_method_lists_its_options_alone(splatseed):
    plain, one = splatseed("upsample", "--help"), splatseed("upsample", "--method", "mls", "--help")
    assert (plain.code, one.code) == (0, 0)
    assert "--mls.k" not in plain.out
    assert "--mls.k INT" in one.out
    assert "--spline.k" not in one.out


def test_a_shell_completes_verbs_and_options(splatseed):
    run = splatseed(COMPLETION, "bash")
    assert (run.code, run.err) == (0, "")
    for words, offered in (
        ("ups", "upsample"),
        ("info --pi", "--picture"),
        ("upsample --mls.k",) * 2,
    ):
        asked = f"COMP_WORDS=(splatseed {words}); COMP_CWORD={len(words.split())}"
        program = f'{run.out}\n{asked}; _tyro_splatseed; printf "%s\\n" "${{COMPREPLY[@]}}"'
        done = subprocess.run(["bash", "-c", program], capture_output=True, text=True, check=True)
        assert offered.split()[-1] in done.stdout.split()
