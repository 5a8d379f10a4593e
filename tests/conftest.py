"""Fixtures shared by all tests."""

from __future__ import annotations

import gc
import importlib.util
import math
import os
import pickle
import sys

from splatseed.runtime.environment import set_thread_defaults

set_thread_defaults()  # before PyTorch and Numba load, as the command line does

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
import pytest
from _pytest.assertion.rewrite import AssertionRewritingHook

from splatseed.io import load_scene
from splatseed.io.staging import atomic_file, locked
from splatseed.scene import Scene
from splatseed.synthetic import Capture, make_capture, write_capture

from .command_line import Run, exit_code

SCENES = Path(os.environ.get("SPLATSEED_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))


@pytest.fixture(autouse=True)
def _untold_compilation(monkeypatch):
    """What commands say on stderr must not depend on what is compiled already."""
    monkeypatch.setattr("splatseed.console.MIN_LOGGED_COMPILATION", math.inf)


@pytest.fixture(scope="session")
def common(tmp_path_factory) -> Path:
    """A folder that all processes of the suite share."""
    folder = tmp_path_factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


@pytest.fixture
def compare_once(request, monkeypatch, common):
    """Compares the same photographs once for all tests that use this, but for ``compare_anew``."""
    from .compared_once import USERS

    folder = common / "compared"
    folder.mkdir(exist_ok=True)
    if "compare_anew" not in request.fixturenames:
        for module, found in USERS:
            monkeypatch.setattr(module, found.__name__, partial(found, folder))


@pytest.fixture
def compare_anew():
    """For tests of what comes of comparing photographs twice."""


@pytest.fixture
def check_anew():
    """For tests of the check-up."""


@pytest.fixture(autouse=True)
def _captures_are_checked_once(request, monkeypatch, common):
    """Holding a capture's parts against each other takes half a second, before all that is made."""
    if "splatseed.checkup.examination" not in sys.modules or "check_anew" in request.fixturenames:
        return
    from .compared_once import CHECKS_OF_POINTS, CHECKS_OF_POSES, checked_once

    folder = common / "checked"
    folder.mkdir(exist_ok=True)
    for module, name in (*CHECKS_OF_POSES, *CHECKS_OF_POINTS):
        of_points = (module, name) in CHECKS_OF_POINTS
        check = checked_once(folder, getattr(module, name), of_points=of_points)
        monkeypatch.setattr(module, name, check)


@pytest.fixture
def draw_curves():
    """For tests of the picture of a run's curves: each run draws its own."""


@pytest.fixture(autouse=True)
def _curves_are_drawn_once(request, monkeypatch, common):
    """Drawing curves takes half a second, at the end of hundreds of runs; others copy the first.

    All processes of the suite do, most of which need not even import what draws.
    """
    run = sys.modules.get("splatseed.training.run")
    if run is None or "draw_curves" in request.fixturenames:
        return
    draw, drawn = run.write_curve_png, common / "curves.png"

    def copy(path, records):
        if not drawn.is_file():
            draw(path, records)
            with atomic_file(drawn) as partial:
                partial.write_bytes(path.read_bytes())
        with atomic_file(path) as partial:
            partial.write_bytes(drawn.read_bytes())

    monkeypatch.setattr(run, "write_curve_png", copy)


@pytest.fixture
def score_often():
    """For tests of the scores in the course of a run: it has as many as a user's."""


@pytest.fixture(autouse=True)
def _runs_are_scored_thrice(request, monkeypatch):
    """Scoring takes a fifth of the time of a test's short run."""
    trainer = sys.modules.get("splatseed.training.trainer")
    if trainer is not None and "score_often" not in request.fixturenames:
        monkeypatch.setattr(trainer, "NUM_TESTS", 3)


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Look for no garbage among the millions of objects that the imports leave, now or later.

    Each process of the suite spends a third of its time to collect tests on it otherwise.
    """
    gc.disable()
    if "PYTEST_XDIST_WORKER" in os.environ:
        _compile_own_part_first()
    found = yield
    gc.freeze()
    gc.enable()
    return found


def _compile_own_part_first() -> None:
    """Compile this process's part of the tests: it finds the rest compiled when it collects.

    All processes collect the same files in the same order, and compiling them takes three quarters
    of that in a fresh clone.
    """
    rewriting = next(f for f in sys.meta_path if isinstance(f, AssertionRewritingHook))
    count = int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    own = int(os.environ["PYTEST_XDIST_WORKER"].removeprefix("gw"))
    for path in sorted(Path(__file__).parent.rglob("test_*.py"))[own::count]:
        spec = rewriting.find_spec(path.stem, [str(path.parent)])
        module = importlib.util.module_from_spec(spec)
        module.__builtins__ = {}  # so that its first import fails: it is compiled, but not run
        with suppress(ImportError):
            spec.loader.exec_module(module)


LONG = {"test_bench_command.py", "test_determinism.py", "test_run.py"}
"""Begun first, so that no process is left alone with one of them at the end."""


def pytest_configure(config) -> None:
    """Files go to processes in this order; else those of few tests, often the longest, go last."""
    config.option.loadscopereorder = False


def pytest_collection_modifyitems(items) -> None:
    """A file's slow tests last: what else fails in it is known before they begin."""
    places = {path: place for place, path in enumerate(dict.fromkeys(i.path for i in items))}
    items.sort(
        key=lambda item: (
            item.path.name not in LONG,
            places[item.path],
            item.get_closest_marker("slow") is not None,
        )
    )


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def set_threads(monkeypatch) -> Iterator[Callable[[int], None]]:
    """Sets Numba's threads and ours until the test ends."""
    available = numba.get_num_threads()

    def set_to(num: int) -> None:
        numba.set_num_threads(min(num, available))
        monkeypatch.setattr("splatseed.progress.available_cpus", lambda: num)

    yield set_to
    numba.set_num_threads(available)


@pytest.fixture(scope="session")
def scenes() -> Path:
    """The folder of real captures; tests that need it are skipped on a machine without it."""
    if not SCENES.is_dir():
        pytest.skip(f"real captures not found at {SCENES}; set SPLATSEED_SCENES to their folder")
    return SCENES


class Room(NamedTuple):
    """The demo's room, seen in some views."""

    capture: Capture  # as it was made, with its true depth
    path: Path  # on disk, a COLMAP scene with depth maps; not to be written to


@pytest.fixture(scope="session")
def room_of(common) -> Callable[[int, int, int], Room]:
    """Makes the room, ``room_of(num_views, width, height)``.

    It takes seconds, so that all processes of the suite share what one of them has made.
    """

    @cache
    def make(num_views: int, width: int, height: int) -> Room:
        folder = common / "rooms" / f"{num_views}_{width}_{height}"
        folder.mkdir(parents=True, exist_ok=True)
        made, path = folder / "made", folder / "room"
        with locked(folder, wait=True):
            if made.is_file():
                return Room(pickle.loads(made.read_bytes()), path)  # noqa: S301  (our own)
            capture = make_capture(0, num_views, width, height)
            write_capture(capture, path)
            made.write_bytes(pickle.dumps(capture))
        return Room(capture, path)

    return make


@pytest.fixture
def rooms_are_small(room_of, monkeypatch):
    """Demo, examples and notebook are given rooms of 96 x 72, made once for all tests."""

    def make(seed=0, num_views=40, width=400, height=300):
        assert seed == 0
        return room_of(num_views, min(width, 96), min(height, 72)).capture

    monkeypatch.setattr("splatseed.synthetic.make_capture", make)


@pytest.fixture(scope="session")
def room_path(room_of) -> Path:
    """A COLMAP scene of the demo's room: 9 views of 96 x 72. Not to be written to."""
    return room_of(9, 96, 72).path


@pytest.fixture(scope="session")
def room(room_path) -> Scene:
    """The same in memory."""
    return load_scene(room_path)


@pytest.fixture(scope="session")
def larger_room_path(room_of) -> Path:
    """The room in 12 views of 96 x 72, with more points. Not to be written to."""
    return room_of(12, 96, 72).path


@pytest.fixture(scope="session")
def sixteen_views(room_of) -> tuple[Capture, Scene]:
    """The room in 16 views of 160 x 120: as it was made, with its true depth, and as it is read."""
    room = room_of(16, 160, 120)
    return room.capture, load_scene(room.path)


class CalledHere:
    """A ``Child`` that runs in this process."""

    def __init__(self, function, *arguments, reports, environment, log):
        self._call, self._log = pickle.dumps((function, arguments)), log
        assert reports
        assert environment

    def result(self, progress):
        function, arguments = pickle.loads(self._call)  # noqa: S301  (our own)
        return function(*arguments, progress=progress)

    def close(self):
        self._log.close()


@pytest.fixture
def pycolmap_here(monkeypatch):
    """Reconstructs in this process, where its child is not the subject: it takes two seconds."""
    monkeypatch.setattr("splatseed.sfm.child.Child", CalledHere)


@pytest.fixture
def splatseed(capsys) -> Callable[..., Run]:
    """Runs ``splatseed WORDS...`` here; only SystemExit may come out of it."""

    def run(*words: object) -> Run:
        capsys.readouterr()
        return Run(exit_code(*words), *capsys.readouterr())

    return run
