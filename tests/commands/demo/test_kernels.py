"""The process that compiles ahead of the demo: who compiles what, and that nobody waits in vain."""

from __future__ import annotations

import time

import pytest

from splatseed.commands.demo import kernels
from splatseed.kernels.compilation import tell
from splatseed.process import tasks
from splatseed.upsample import METHODS

TOO_LONG = "time.sleep(60)"


@pytest.fixture
def program(monkeypatch):
    """Sets what the second process runs, which has ``folder``."""
    begin = "import pathlib, pickle, sys, time; call = pickle.loads(pickle.load(sys.stdin.buffer));"
    begin += "folder = pathlib.Path(call[1][0]);"
    return lambda text: monkeypatch.setattr(tasks, "_PROGRAM", begin + text)


def test_it_starts_with_the_first_compilation_and_ends_with_the_block(program):
    program(TOO_LONG)
    with kernels.kernels_ahead(training=False) as ahead:
        assert ahead._child is None
        tell(begins=True)
        tell(begins=False)
        started = ahead._child
        tell(begins=True)
        assert ahead._child is started
        assert started.process.poll() is None
    assert started.process.poll() is not None
    tell(begins=True)
    assert ahead._child is started


def test_a_part_is_compiled_by_one_alone_and_waited_for(program):
    program(
        "(folder / 'auto').touch(); time.sleep(0.5); (folder / 'auto.done').touch(); time.sleep(60)"
    )
    with kernels.kernels_ahead(training=False) as ahead:
        ahead.start()
        while not (ahead._folder / "auto").exists():
            time.sleep(0.01)
        ahead.wait_for("auto")
        assert (ahead._folder / "auto.done").exists()
        ahead.wait_for("voronoi")  # which is then ours
        assert not kernels._claim(ahead._folder, "voronoi")


def test_a_process_that_ended_is_not_waited_for(program):
    program("(folder / 'auto').touch()")
    with kernels.kernels_ahead(training=False) as ahead:
        ahead.start()
        ahead._child.process.wait()
        ahead.wait_for("auto")
        assert not (ahead._folder / "auto.done").exists()


def test_what_the_second_process_does_is_a_small_demo(tmp_path, monkeypatch):
    """A failure there would go unseen: the demo would compile by itself, and be slow."""
    pytest.importorskip("gsplat", reason="training needs PyTorch and gsplat's strategies")
    failed = []
    real = kernels._compile

    def compile_part(*words):
        try:
            real(*words)
        except Exception as error:
            failed.append(error)
            raise

    monkeypatch.setattr(kernels, "_compile", compile_part)
    parts = (*kernels.PARTS, kernels.TRAINING)
    kernels.compile_parts(str(tmp_path), *parts)
    assert not failed
    assert all((tmp_path / f"{part}.done").exists() for part in parts)
    assert (tmp_path / "small/preview.png").exists()
    assert (tmp_path / "small/run/metrics.json").exists()


def test_what_the_second_process_compiles_comes_last_in_the_first():
    names = kernels.KernelsAhead(None, ()).last_first(list(METHODS))
    assert sorted(names) == sorted(METHODS)
    assert names[-3:] == list(kernels.PARTS[::-1])
