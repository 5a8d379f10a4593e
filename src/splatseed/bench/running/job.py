"""One run of the benchmark, from its specification to its result.

Promise: an interrupted run resumes from its checkpoint, if there is one, and else restarts; files
that differ from the planned ones are an error; every failure is returned as an ``Outcome`` and
never raised, so that one bad run does not end the others.
"""

from __future__ import annotations

import math
import shutil
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from splatseed.bench.planning.digest import cloud_digest, depth_digest, scene_digest
from splatseed.bench.planning.records import RunResult, RunSpec, plain
from splatseed.bench.planning.scenes import open_scene
from splatseed.bench.running.kept import (
    ERROR,
    RESULT,
    kept_files,
    read_result,
    result_bytes,
    write_kept,
)
from splatseed.bench.running.seeds import is_full, make_seeds, scene_of
from splatseed.bench.running.twins import find_twin, fingerprint, note_training
from splatseed.errors import SceneFormatError, SplatseedError
from splatseed.io.staging import check_output
from splatseed.process.interruption import interruption
from splatseed.process.memory import peak_bytes
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.scores import TrainingResult
from splatseed.seeding.advice import DEFAULT_METHOD
from splatseed.train.depths import stereo_size
from splatseed.views.view import user_cache_dir

if TYPE_CHECKING:  # PyTorch, which takes a while
    from splatseed.evaluate import Covisible
    from splatseed.splat.metrics import Lpips
    from splatseed.train.run import TrainingRun
    from splatseed.views.view import View

TRAIN = "train"
COVISIBLE, DEPTHS = "covisible", "depths"
"""The folders of what is known of test views' pixels and of depth by stereo, beside the ledger."""


@dataclass(frozen=True)
class JobOptions:
    """Options that do not affect the result.

    Args:
        keep_models: Keep the trained Gaussians.
        lpips: Measure LPIPS.
    """

    keep_models: bool = False
    lpips: bool = False


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Args:
        status: Done; failed, for the reason in ``error``; or interrupted, to be resumed.
        result: What it gave, if it is done.
        error: One line, if it failed.
    """

    status: Literal["done", "failed", "interrupted"]
    result: RunResult | None = None
    error: str = ""


def run_job(
    spec: RunSpec,
    work: Path,
    target: Path,
    options: JobOptions | None = None,
    progress: Progress = silent,
) -> Outcome:
    """Execute a run, unless the kept files show that it is done.

    The first SIGINT or SIGTERM during training leaves a checkpoint; while results are written,
    which takes seconds, signals are ignored.

    Args:
        spec: The run.
        work: The folder it works in, which is removed when it is done.
        target: The folder for what is kept.
        options: What else to do.
        progress: Told the stages, training among them.
    """
    try:
        kept = read_result(target, spec.key)
        if kept is not None:
            return Outcome("done", kept)
        _remove_leftovers(target)
        check_output(target, kind="bench", overwrite=True)
        result = _train(spec, work, target, options or JobOptions(), progress)
    except KeyboardInterrupt:
        return Outcome("interrupted")
    except Exception as error:  # noqa: BLE001  (whatever it is, the other runs go on)
        return Outcome("failed", error=_keep_error(target, error))
    if result is None:
        return Outcome("interrupted")
    shutil.rmtree(work, ignore_errors=True)
    return Outcome("done", result)


def _remove_leftovers(target: Path) -> None:
    """Remove what a killed attempt left behind; nobody else has this run now."""
    for partial in target.parent.glob(f".{target.name}.partial-*"):
        shutil.rmtree(partial, ignore_errors=True)


def _train(
    spec: RunSpec, work: Path, target: Path, options: JobOptions, progress: Progress
) -> RunResult | None:
    """The result, once it is kept; None if the run was interrupted and left a checkpoint."""
    progress("read", 0.0)
    scene = scene_of(spec)
    _check_unchanged(scene, spec)
    lpips = _load_lpips() if options.lpips else None
    seeds, seconds = make_seeds(scene, spec, progress, target.parent.parent)
    mark = fingerprint(spec, seeds)
    twin = find_twin(target, mark, seconds, models=options.keep_models, lpips=options.lpips)
    if twin is not None:
        write_kept(target, {**twin[1], RESULT: result_bytes(spec, twin[0])})
        return twin[0]
    bench = target.parent.parent
    run = _prepare(scene.replace(points=seeds), work, spec, bench, progress)
    if not run.train(lambda step: progress(TRAIN, step / spec.training.max_steps)):
        return None
    with interruption():
        result = _result(_finish(run, spec, target, lpips, progress), run, seconds)
        files = kept_files(work, models=options.keep_models)
        write_kept(target, {**files, RESULT: result_bytes(spec, result)})
        note_training(target, mark)
    return result


def _check_unchanged(scene: Scene, spec: RunSpec) -> None:
    """Refuse a scene that differs from the plan: changed since, or different on this node."""
    folder = scene.source.image_dir if scene.source else None
    same = folder is not None and scene_digest(scene, folder) == spec.scene_digest
    if same and spec.depth_digest and scene.depths is not None:
        same = depth_digest(scene.depths) == spec.depth_digest
    if same and spec.cloud_digest:
        same = cloud_digest(Path(spec.cloud_path)) == spec.cloud_digest
    if not same:
        raise SceneFormatError(
            f"the files of {spec.scene_path} as they were when the benchmark was planned",
            found="other points, cameras, photographs, depth maps or scan",
            fix="Start the benchmark again: it plans anew.",
        )


def _prepare(
    scene: Scene, work: Path, spec: RunSpec, bench: Path, progress: Progress
) -> TrainingRun:
    """A run that goes on where it stopped; if it cannot, one that begins.

    What stereo knows, for growth, is found once for all runs of a repeat, and its time counts in
    each; not where seeds by ``auto`` have paid for it, as ``splatseed train`` shares the two.
    """
    from splatseed.train.run import RunOptions, prepare_run  # noqa: PLC0415  (PyTorch)

    every = spec.training.test_every
    size = stereo_size(scene.split(every)[0], spec.settings, spec.settings.backend)
    ways: dict[str, Any] = {
        "cache_dir": user_cache_dir(),
        "depths": bench / DEPTHS / f"{spec.scene_digest}_{every}_{size}_{spec.repeat}.npz",
        "seeding_knew": plain(spec.arm.method) == DEFAULT_METHOD and not is_full(scene, spec),
    }
    try:
        resume = RunOptions(resume=True, **ways)
        return prepare_run(scene, work, spec.settings, resume, progress=progress)
    except SplatseedError:
        if not work.exists():
            raise
    anew = RunOptions(overwrite=True, **ways)
    return prepare_run(scene, work, spec.settings, anew, progress=progress)


def _load_lpips() -> Lpips:
    from splatseed.splat.metrics import load_lpips  # noqa: PLC0415  (PyTorch)

    return load_lpips()


def _finish(
    run: TrainingRun, spec: RunSpec, target: Path, lpips: Lpips | None, progress: Progress
) -> TrainingResult:
    from splatseed.evaluate import evaluate_views  # noqa: PLC0415  (PyTorch)

    return run.finish(
        lambda render, views: evaluate_views(
            render,
            views,
            lpips=lpips,
            covisible=_covisible(spec, target, views, progress),
            progress=progress,
        ),
        progress,
    )


def _covisible(spec: RunSpec, target: Path, views: Sequence[View], progress: Progress) -> Covisible:
    """The pixels that two training views see: computed once per scene, stored beside the ledger.

    The scene is reopened for it, so that an arm's depth maps make no difference.
    """
    from splatseed.splat.covisible import (  # noqa: PLC0415  (PyTorch)
        find_covisible,
        pixel_masks,
        read_covisible,
        write_covisible,
    )

    every = spec.training.test_every
    kept = target.parent.parent / COVISIBLE / f"{spec.scene_digest}_{every}.npz"
    grids = read_covisible(kept)
    if grids is None:
        scene = open_scene(Path(spec.scene_path), images=spec.images)
        grids = find_covisible(scene, every, progress)
        write_covisible(kept, grids)
    return pixel_masks(grids, views)


def _result(trained: TrainingResult, run: TrainingRun, upsample_seconds: float) -> RunResult:
    return RunResult(
        scores=trained.scores,
        curve=tuple(point for point in trained.curve if math.isfinite(point.psnr)),
        num_seeds=trained.num_seeds,
        upsample_seconds=upsample_seconds,
        train_seconds=trained.train_seconds,
        peak_bytes=peak_bytes(),
        device=run.device,
        peak_gpu_bytes=run.peak_gpu_bytes,
    )


def _keep_error(target: Path, error: Exception) -> str:
    """The error in one line; its traceback is stored if possible."""
    text = "".join(traceback.format_exception(error))
    try:
        write_kept(target, {ERROR: text.encode("utf-8", "backslashreplace")})
    except SplatseedError as another:
        print(f"{text}\n{another}", file=sys.stderr)  # noqa: T201  (the log of the run)
    ours = isinstance(error, SplatseedError)
    said = str(error) if ours else traceback.format_exception_only(error)[-1]
    return " ".join(said.split())
