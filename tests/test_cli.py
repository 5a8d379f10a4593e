"""The command line as a process: exit codes, streams, terminals and signals."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
from importlib.metadata import entry_points, version

import numpy as np
import pytest

from splatseed.cli import COMPLETION, VERBS, main
from splatseed.io.ply import write_ply
from splatseed.pointcloud import PointCloud

COMMAND = (sys.executable, "-c", "from splatseed.cli import main; main()")


@pytest.fixture
def ply(rng, tmp_path):
    """A wavy sheet of 300 points."""
    xyz = rng.random((300, 3))
    xyz[:, 2] = 0.1 * np.sin(9 * xyz[:, 0])
    rgb = (255 * rng.random(xyz.shape)).astype(np.uint8)
    write_ply(tmp_path / "cloud.ply", PointCloud(xyz, rgb))
    return tmp_path / "cloud.ply"


def _run(*words, command=COMMAND, **options):
    words = [*command, *(str(word) for word in words)]
    return subprocess.run(words, capture_output=True, check=False, timeout=120, **options)


def test_the_command_is_installed():
    (command,) = entry_points(group="console_scripts", name="splatseed")
    assert command.load() is main


def test_from_end_to_end_a_terminal_sees_progress_and_stdout_does_not(ply, tmp_path):
    master, terminal = pty.openpty()
    words = [*COMMAND, "upsample", str(ply), "-o", str(tmp_path / "out"), "--ratio", "100"]
    # A bar needs a terminal that can move its cursor, which the test's own may not be.
    environment = os.environ | {"TERM": "xterm"}
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=terminal, env=environment
    ) as process:
        os.close(terminal)
        shown = _read_all(master)
        out = process.communicate(timeout=120)[0].decode()
    assert process.returncode == 0
    assert "neighbours" in shown
    assert "\x1b[" in shown
    assert not re.search("warning|error|traceback", shown, re.IGNORECASE)
    assert not set(out) & {"\r", "\x1b"}
    assert "points out" in out
    assert "30,000" in out
    assert (tmp_path / "out/sparse/0/points3D.bin").is_file()


def _read_all(master):
    """All that is written to a terminal until its last writer closes it."""
    pieces = []
    try:
        while piece := os.read(master, 65536):
            pieces.append(piece)
    except OSError:  # Linux's way to say that nobody writes any more
        pass
    os.close(master)
    return b"".join(pieces).decode()


SLOW_WRITER = """
import sys, time
from pathlib import Path
from splatseed.cli import main
from splatseed.io import colmap

def write(path, points, tracks=None):
    Path(path).write_bytes(b"half")
    print("writing", flush=True)
    time.sleep(60)

colmap.write_points3d = write
main()
"""


def test_stopping_while_writing_leaves_nothing(ply, tmp_path):
    """By SIGTERM; that SIGINT ends each verb likewise is tested in tests/runtime."""
    words = [sys.executable, "-c", SLOW_WRITER, "upsample", str(ply), "-o", str(tmp_path / "a/out")]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        for line in process.stdout:
            if line == "writing\n":
                break
        process.terminate()
        _, err = process.communicate(timeout=60)
    assert process.returncode == 143
    assert "interrupted" in err
    assert "Traceback" not in err
    assert [path.name for path in tmp_path.iterdir()] == [ply.name]


@pytest.mark.parametrize("words", [["info", "PLY"], ["upsample", "--help"]])
def test_a_reader_that_leaves_early_is_no_traceback(words, ply):
    read, write = os.pipe()
    os.close(read)
    words = [sys.executable, "-m", "splatseed", *(str(ply) if w == "PLY" else w for w in words)]
    run = subprocess.run(words, stdout=write, stderr=subprocess.PIPE, check=False, timeout=60)
    os.close(write)
    assert (run.returncode, run.stderr) == (1, b"")


def test_names_that_are_no_text(ply, tmp_path):
    odd = os.fsencode(tmp_path) + b"/odd\xff.ply"
    os.link(ply, odd)
    run = _run("info", os.fsdecode(odd))
    assert run.returncode == 0
    assert b"odd\\udcff.ply" in run.stdout


def test_help_names_every_verb_and_the_version(splatseed):
    for words in ([], ["-h"], ["--help"]):
        run = splatseed(*words)
        assert (run.code, run.err) == (0, "")
        for verb, does in VERBS.items():
            assert re.search(rf"^  {verb} +{re.escape(does)}", run.out, re.MULTILINE)
    for option in ("-V", "--version"):
        assert splatseed(option).out == f"splatseed {version('splatseed')}\n"


def test_help_of_a_method_lists_its_options_alone(splatseed):
    plain, one = splatseed("upsample", "--help"), splatseed("upsample", "--method", "mls", "--help")
    assert "--mls.k" not in plain.out
    assert "--mls.k INT" in one.out
    assert "--spline.k" not in one.out


def test_a_shell_completes_verbs_and_options(splatseed):
    run = splatseed(COMPLETION, "bash")
    assert (run.code, run.err) == (0, "")
    for words in ("ups -> upsample", "info --pi -> --picture", "upsample --mls.k -> --mls.k",
                  "flight --js -> --json"):  # fmt: skip
        typed, offered = words.split(" -> ")
        asked = f"COMP_WORDS=(splatseed {typed}); COMP_CWORD={len(typed.split())}"
        program = f'{run.out}\n{asked}; _tyro_splatseed; printf "%s\\n" "${{COMPREPLY[@]}}"'
        done = subprocess.run(["bash", "-c", program], capture_output=True, text=True, check=True)
        assert offered in done.stdout.split()
