"""``splatseed train``: from a scene and its seeds to trained Gaussians."""

from __future__ import annotations

import json
import logging
import math
import sys
import time
import tomllib
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_type_hints

import tyro
from rich import progress as rich_progress
from rich.table import Column

from splatseed.commands.options import parse_options, parse_some
from splatseed.console import (
    ERR,
    add_results,
    print_message,
    print_next,
    print_note,
    print_pairs,
    stage_display,
)
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io import load_scene
from splatseed.io.files import read_text
from splatseed.requirements import require
from splatseed.runtime.interruption import exit_code
from splatseed.scores import TrainingResult
from splatseed.seeding.budget import in_rho
from splatseed.settings import describe_type, fits
from splatseed.text import did_you_mean, format_duration, quoted, visible
from splatseed.training.duration import TOO_LONG, RunSpeed, options_for_an_hour, seconds_left
from splatseed.training.folder import RunFolder
from splatseed.training.request import DEFAULTS, TrainRequest
from splatseed.training.settings import TrainSettings

if TYPE_CHECKING:  # importing PyTorch takes a while: --help must not wait for it
    from splatseed.training.run import TrainingRun
    from splatseed.viewer.server import TrainingViewer

BAR_WIDTH = 12
HOST, PORT = "127.0.0.1", 8080
"""The address of the viewer, if the port is free."""
MIN_STEPS, WINDOW, REPORT_AFTER, ESTIMATE_EVERY = 5, 100, 10.0, 5
"""Estimating the time left: minimum steps, most recent steps used, seconds of training before it is
printed, and steps between estimates."""
MIN_REPORTED = 120.0
"""Seconds of remaining training from which on they are printed."""
RUN_FACTS = {"splatseed", "points", "photographs", "split", "dropped", "excluded", "mask_files",
    "device", "versions", "near_plane", "frame"}  # fmt: skip
"""Keys of config.json that are not options."""
EXCLUSIVE = (
    ("start", "seeding"),
    ("start", "refine_poses"),
    ("start", "region"),
    ("long_side", "data_factor"),
)
"""Pairs of exclusive options: one on the command line replaces the other of a file."""
DEFAULT = TrainRequest()
NESTED = {"request", "settings", "named"}
"""Fields that are no options."""


@dataclass(frozen=True)
class Options:
    """Train 3D Gaussians on a scene, on a GPU or on the CPU, and score them."""

    scene: Annotated[Path, tyro.conf.Positional]
    """A scene with photographs, as splatseed upsample writes it."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The folder of the run."""
    request: Annotated[TrainRequest, tyro.conf.arg(name="")] = DEFAULT
    """How to train; its fields are options of their own."""
    view: bool = False
    """Watch training in the browser; pause it, or stop early and keep the result (extra view)."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A .toml with these options, or a run's config.json; the command line takes precedence."""


@dataclass(frozen=True)
class _ConfigFile:
    config: Path | None = None


def parse(arguments: list[str]) -> Options:
    """Parse the options; the command line takes precedence over the file of --config."""
    path = parse_some(_ConfigFile, arguments).config
    words = _words(arguments)
    given = {} if path is None else _read_config(path, words)
    default = None if path is None else _with_options(path, given)
    options = parse_options(Options, "train", arguments, default)
    named = (words | given.keys()) & {each.name for each in fields(TrainSettings)}
    return replace(options, request=replace(options.request, named=frozenset(named)))


def _words(arguments: Sequence[str]) -> set[str]:
    options = {each.partition("=")[0] for each in arguments if each.startswith("--")}
    names = {option.removeprefix("--").replace("-", "_") for option in options}
    return {"seeding" if name == "seeds" else name for name in names}


def _with_options(path: Path, content: Mapping[str, Any]) -> Options:
    kinds = (TrainSettings, TrainRequest, Options)
    hints = {kind: get_type_hints(kind) for kind in kinds}
    known = {name: kind for kind in kinds for name in hints[kind] if name not in NESTED}
    given: dict[type, dict[str, Any]] = {kind: {} for kind in kinds}
    for name, value in content.items():
        if name not in known:
            raise SceneFormatError(
                f"options of splatseed train in {path}",
                found=repr(name),
                fix=f"{did_you_mean(name, known)}Run splatseed train --help.",
            )
        hint = hints[known[name]][name]
        is_path = Path in (hint, *get_args(hint)) and isinstance(value, str)
        given[known[name]][name] = Path(value) if is_path else value
        if not fits(given[known[name]][name], hint):
            raise SceneFormatError(
                f"{name} = {describe_type(hint)} in {path}",
                found=repr(value)[:80],
                fix="Correct the file.",
            )
    settings = replace(DEFAULTS, **given[TrainSettings])
    request = TrainRequest(**given[TrainRequest], settings=settings)
    paths: dict[str, Any] = {"scene": tyro.MISSING, "output": tyro.MISSING}
    return Options(**{**paths, **given[Options]}, request=request)


def _read_config(path: Path, words: Collection[str]) -> dict[str, Any]:
    """Read options from a .toml or a run's config.json, without those that ``words`` exclude."""
    try:
        text = read_text(path)
        content = json.loads(text) if path.suffix.lower() == ".json" else tomllib.loads(text)
        if not isinstance(content, dict):
            raise TypeError(f"a {type(content).__name__}")  # noqa: TRY301  (translated below)
    except FileNotFoundError:
        raise SceneNotFoundError(f"a file {path}", found="none", fix="Check the path.") from None
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise SceneFormatError(
            f"{path} to hold options of splatseed train, as TOML or a run's config.json",
            found=" ".join(str(error).split())[:160],
            fix="Write lines such as max_steps = 7000.",
        ) from None
    seeds = content.pop("seeds", None)
    if isinstance(seeds, dict):  # a run's: what its seeds were
        content["seeding"] = None if content.get("start") else content.get("seeding")
    elif seeds is not None:
        content["seeding"] = seeds
    if (names := content.get("exclude")) is not None:
        names = names if isinstance(names, list) else [names]
        # Else the command line would append to it.
        content["exclude"] = () if "exclude" in words else tuple(map(str, names))
    if isinstance(content.get("budget"), float):
        content["budget"] = str(content["budget"])
    excluded = {b for pair in EXCLUSIVE for a, b in (pair, pair[::-1]) if a in words} | RUN_FACTS
    return {k: v for k, v in content.items() if k not in excluded and v is not None}


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse(arguments)
    require(
        "torch", "gsplat", "flip_evaluator",
        *["viser"] * options.view,
        *["pycolmap"] * options.request.refine_poses,
        *["tensorboard"] * options.request.tensorboard,
    )  # fmt: skip
    from splatseed.splat.evaluate import evaluate_views
    from splatseed.training.api import prepare_training

    findings: list[Finding] = []
    if options.request.resume and not RunFolder(options.output).is_run:
        text = f"There is no run to resume in {options.output}: a new one starts."
        findings.append(Finding("no-run-to-resume", text, "info"))
    # ``api.train``, with displays.
    with stage_display() as clock:
        clock("read", 0.0)
        training = prepare_training(
            options.scene, options.output, options.request, note=findings.append, progress=clock
        )
    print_note(*findings)
    _announce(options, training)
    left = _TimeLeft(training, per_pixel=_per_pixel(options))
    with _watched(options, training) as viewer, _training_bar(training, left) as show:

        def on_step(step: int) -> None:
            left.on_step(step)
            show(step)
            if viewer is not None:
                viewer.on_step(step)

        done = training.train(on_step)
    if not done and not (viewer and viewer.kept):
        again = f"{quoted(options.scene)} -o {quoted(options.output)} --resume"
        saved = f"interrupted after step {training.state.step:,}; saved. Continue with:"
        print_message(f"\n{saved}\n  splatseed train {again}", logging.WARNING)
        sys.exit(exit_code())
    with stage_display(clock):
        result = training.finish(partial(evaluate_views, progress=clock), clock)
    _summarise(options, training, result)


def _announce(options: Options, training: TrainingRun) -> None:
    settings, views = training.settings, training.trainer.train_views
    for name in settings.unused:
        text = f"{name} has no effect with strategy {settings.traits.name}."
        print_note(Finding("unused-setting", text))
    chosen = settings.strategy == DEFAULTS.strategy
    strategy = f"{settings.traits.name} ({settings.strategy})" if chosen else settings.strategy
    tests = len(training.trainer.test_views)
    parts = f"{len(views)} training and {tests} test views" if tests else f"{len(views)} views"
    print_message(
        f"{visible(options.scene)} ({parts} of {views[0].width} x {views[0].height}, "
        f"{len(training.state.params['means']):,} Gaussians)\n  -> strategy {strategy}, "
        f"{settings.max_steps:,} steps, seed {settings.seed}, on {training.device}\n  -> "
        f"{visible(options.output)}"
    )


@contextmanager
def _watched(options: Options, training: TrainingRun) -> Iterator[TrainingViewer | None]:
    """Serve the run to browsers while the block runs, with --view."""
    if not options.view:
        yield None
        return
    from splatseed.viewer.server import TrainingViewer, free_port

    posed = training.folder.scene  # there is one if poses were refined
    scene = load_scene(posed if posed.is_dir() else options.scene, require_points=False)
    try:
        port = free_port(HOST, PORT)
    except ParameterError:  # it is taken
        port = free_port(HOST, 0)
    name = options.scene.name or str(options.scene)
    viewer = TrainingViewer(training, scene, name, HOST, port)
    print_message(f"  -> watch it at http://localhost:{port}")
    try:
        yield viewer
    finally:
        viewer.close()


def _per_pixel(options: Options) -> bool:
    return options.request.budget is None or in_rho(options.request.budget)


class _TimeLeft:
    """Estimates the remaining time of a run by its own steps, and prints it once.

    A pause by the viewer counts as slow steps, until ``WINDOW`` more are done.
    """

    def __init__(self, training: TrainingRun, *, per_pixel: bool) -> None:
        self.seconds: float | None = None  # until the last step; None as long as it is unknown
        self._training, self._per_pixel, self._is_printed = training, per_pixel, False
        self._steps: deque[float] = deque(maxlen=WINDOW + 1)  # when the last ones were done

    def on_step(self, step: int) -> None:
        """Update the estimate after a step."""
        self._steps.append(time.monotonic())
        elapsed = self._steps[-1] - self._steps[0]
        if len(self._steps) <= MIN_STEPS or step % ESTIMATE_EVERY:
            return
        training = self._training
        view, device = training.trainer.train_views[0], training.trainer.device.type
        seconds, pixels = elapsed / (len(self._steps) - 1), view.width * view.height
        now = RunSpeed(step, seconds, training.count(), pixels, device)
        self.seconds = seconds_left(training.settings, now)
        if not self._is_printed and elapsed > REPORT_AFTER:
            self._is_printed = True
            print_note(*self._findings(now, self.seconds))

    @property
    def text(self) -> str:
        """The remaining time for the progress bar; empty until it is known."""
        return "" if self.seconds is None else f"{timedelta(seconds=round(self.seconds))} left"

    def _findings(self, now: RunSpeed, left: float) -> Iterator[Finding]:
        settings, view = self._training.settings, self._training.trainer.train_views[0]
        steps = f"{settings.max_steps - now.step:,} steps that are left"
        slow = now.device == "cpu" and left > TOO_LONG
        if slow or (left > MIN_REPORTED and not ERR.is_terminal):
            text = f"The {steps} take about {format_duration(left)}."
            yield Finding("training-time", text, "info")
        if slow:
            side = round(max(view.width, view.height) * settings.factor)
            flags = options_for_an_hour(settings, now, side, per_pixel=self._per_pixel)
            text = f"On this CPU, training with {flags} takes about an hour; a GPU is much faster."
            yield Finding("training-time", text, "info")


@contextmanager
def _training_bar(training: TrainingRun, left: _TimeLeft) -> Iterator[Callable[[int], None]]:
    """Yield a function that shows the steps done; it draws nothing if stderr is no terminal."""
    if not ERR.is_terminal:
        yield lambda _: None
        return
    columns = bar_columns()
    with rich_progress.Progress(*columns, console=ERR, transient=True, expand=True) as bar:
        first, total = training.state.step, training.settings.max_steps
        task = bar.add_task("", total=total, completed=first, left="")

        def show(step: int) -> None:
            line = _line(training, bar.tasks[0].speed)
            bar.update(task, completed=step, description=line, left=left.text)

        yield show


def bar_columns() -> tuple[rich_progress.ProgressColumn, ...]:
    """Return columns: steps and remaining time in full, then the rest, cut to the line."""
    full = Column(no_wrap=True, overflow="ignore")
    rest = Column(ratio=1, no_wrap=True, overflow="ellipsis")
    return (
        rich_progress.BarColumn(BAR_WIDTH, table_column=full),
        rich_progress.MofNCompleteColumn(table_column=full),
        rich_progress.TextColumn("{task.fields[left]}", table_column=full),
        rich_progress.TextColumn("{task.description}", markup=False, table_column=rest),
    )


def _line(training: TrainingRun, steps_per_second: float | None) -> str:
    records = training.state.records
    if not records:
        return ""
    last = records[-1]
    tested = next((r.test_psnr for r in reversed(records) if r.test_psnr is not None), None)
    test = "" if tested is None else f", test {tested:.2f}"
    speed = "" if steps_per_second is None else f"  {steps_per_second:.1f} steps/s"
    # Most important first: a narrow terminal cuts off the end.
    return (
        f"PSNR {last.train_psnr:.2f}{test} dB  {last.num_gaussians:,} Gaussians{speed}"
        f"  loss {last.loss:.4f}"
    )


def _summarise(options: Options, training: TrainingRun, result: TrainingResult) -> None:
    scores, seconds, output = result.scores, result.train_seconds, options.output
    exposed = training.settings.exposure != "none"
    psnr = f"{scores.psnr:.2f} dB" if math.isfinite(scores.psnr) else "infinite"
    scored = [
        ("test PSNR", psnr),
        *[("colour-corrected", f"{scores.cc_psnr or 0.0:.2f} dB")] * exposed,
        ("test SSIM, FLIP", f"{scores.ssim:.4f}, {scores.flip or 0.0:.4f}"),
    ]
    pictures = [str(output / "renders")] if scores.per_image else []
    rows = [
        *(scored if scores.per_image else [("score", "none, as no photograph was held out")]),
        ("Gaussians", f"{scores.num_gaussians:,} from {result.num_seeds:,} seeds"),
        ("training", f"{seconds:.1f} s for {result.steps:,} steps"),
        ("Gaussians in", str(training.folder.gaussians)),
        ("pictures", ", ".join([*pictures, str(output / "curve.png")])),
    ]
    print_pairs("splatseed train", rows)
    add_results(output=output, gaussians=training.folder.gaussians, **result.to_dict())
    if held := result.held_by_memory_at:
        text = f"memory limited the run to {held:,} Gaussians; results may vary between machines."
        fix = f"Pass --budget {held} for the same result everywhere."
        print_note(Finding("memory-limit", text, fix=fix))
    print_next(_next_commands(output, scored=bool(scores.per_image)))


def _next_commands(output: Path, *, scored: bool) -> list[tuple[str, str]]:
    """Return the commands for a finished run; LPIPS only where its weights are."""
    from splatseed.splat.lpips import has_lpips_weights

    view = ("look at it", f"splatseed view {quoted(output)}")
    share = ("share it", f"splatseed export {quoted(output)} -o {quoted(f'{output}.html')}")
    score = ("score again, with LPIPS", f"splatseed evaluate {quoted(output)}")
    return [view, share, *[score] * (scored and has_lpips_weights())]
