"""Help that shows what is common first, and suggestions for what was mistyped."""

from __future__ import annotations

import re
import shutil
import subprocess
from importlib.metadata import version

import pytest

OF_UNDISTORT = {"-h", "--help", "-o", "--output", "--threads", "--overwrite", "--no-overwrite",
                "--verbose", "--no-verbose"}  # fmt: skip


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["upsample", "x", "-o", "y", "--ratoi", "4"], "Did you mean --ratio?"),
        (["upsample", "x", "-o", "y", "--mls.kk=4"], "Did you mean --mls.k?"),
        (["upsample", "x", "-o", "y", "--method", "msl"], "Did you mean mls?"),
        (["train", "x", "-o", "y", "--max-step", "4"], "Did you mean --max-steps?"),
        (["train", "x", "-o", "y", "--strategy", "defalt"], "Did you mean default?"),
        (
            ["upsample", "x", "-o", "y", "--spline.smoothing", "gvc"],
            "number or gcv; found 'gvc'. Did you mean gcv?",
        ),
        (["train", "x", "-o", "y", "--backend", "gpu"], "Did you mean cuda?"),
        (["upsmaple"], "Did you mean upsample?"),
        (["Info"], "Did you mean info?"),
        (["--verison"], "Did you mean --version?"),
    ],
)
def test_a_slip_gets_a_suggestion(words, says, splatseed):
    run = splatseed(*words)
    assert (run.code, run.err.count("\n")) == (2, 1)
    assert says in run.err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--strategy", "defalt"], "none-3dgs; found 'defalt'. Did you mean default?"),
        (["--strategy", "zzz"], "found 'zzz'. Run splatseed train --help to see what each is."),
        (["--max-steps", "many"], "expected --max-steps as a whole number; found 'many'."),
        (["--frobnicate"], "found unrecognized option"),
    ],
)
def test_a_value_that_cannot_be_is_told_with_its_option(words, says, splatseed):
    run = splatseed("train", "x", "-o", "y", *words)
    assert (run.code, run.err.count("\n")) == (2, 1)
    assert says in run.err
    assert "Expected one of" not in run.err


def test_what_is_like_nothing_gets_none(splatseed):
    assert "Did you mean" not in splatseed("upsample", "x", "-o", "y", "--zzz").err
    assert "Did you mean" not in splatseed("qqq").err


def test_the_short_flag_for_the_version(splatseed):
    assert splatseed("-V").out == f"splatseed {version('splatseed')}\n"


def test_upsamples_help_is_short_and_says_where_the_rest_is(splatseed):
    short = splatseed("upsample", "--help")
    assert short.code == 0
    assert len(short.out.splitlines()) < 90
    assert "--method" in short.out
    assert "--mls.k" not in short.out
    assert "--help-all" in short.out
    assert "None" not in short.out  # of choices: their defaults are in words
    words = " ".join(re.sub("[│|]", " ", short.out).split())
    assert "The scene folder to write. (without it: a recommendation for --budget and" in words
    assert ".laz, .e57" in words
    one = splatseed("upsample", "--method", "mls", "--help").out
    assert "--mls.k" in one
    assert "--spline.k" not in one
    every = splatseed("upsample", "--help-all").out
    assert "--mls.k" in every
    assert "--spline.k" in every


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs a shell")
@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["ups"], {"upsample"}),
        (["info", "--pi"], {"--picture"}),
        (["train", "x", "--max-s"], {"--max-steps"}),
        (["bench", "--exec"], {"--executor"}),
        (["undistort", "-"], OF_UNDISTORT),
        (["train", "x", "-o", "y", "--data-f"], {"--data-factor"}),
        (["sfm", "--poses"], {"--poses-from"}),
        (["upsample", "x", "--mls.k"], {"--mls.k"}),
        (["upsample", "--help-"], {"--help-all"}),
        (["bench", "re"], {"report"}),
        (["bench", "compare", "a", "b", "--out"], {"--output"}),
        (["bench", "report", "--from"], {"--from-scenes"}),
        (["bench", "-o", "re"], set()),
        (["train", "sc"], set()),  # files, by the shell itself
        (["train", "a", "b", "c", "d", "e", "f", "g", "h", "i", "''"], set()),
        (["train", "a", "b", "c", "d", "e", "f", "g", "h", "i", "a-b"], set()),
    ],
)
def test_a_shell_completes_verbs_and_options(words, offered, splatseed):
    script = splatseed("--completion", "bash")
    assert script.code == 0
    typed = " ".join(["splatseed", *words])
    program = (
        f"{script.out}\nCOMP_WORDS=({typed}); COMP_CWORD={len(words)}; _splatseed;"
        ' printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == offered
    assert done.stderr == ""


def test_another_shell_is_told_what_there_is(splatseed):
    run = splatseed("--completion", "fish")
    assert (run.code, "bash or zsh" in run.err) == (2, True)
    assert splatseed("--completion", "zsh").out.startswith("autoload")
