"""One run of the benchmark: its seeds, its training, its scores, and the folder that keeps them.

A run's folder appears whole or not at all, and keeps models only on request. Seeds are the points
that ``splatseed upsample`` would write; their time is that of upsampling and thinning, without the
compilation of kernels. ``BENCH/seeds``, ``depths`` and ``covisible`` hold what several runs share.
"""

from __future__ import annotations

import json
import math
import shutil
import socket
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from splatseed.bench.plan import CLOUD, SFM, WITH_CLOUD, RunResult, RunSpec, plain
from splatseed.bench.runs import ERROR, RESULT, Run, package_version, run_folder
from splatseed.bench.scenes import SceneFacts, fingerprints, open_scene
from splatseed.errors import (
    OutputError,
    ParameterError,
    PointCloudError,
    SceneFormatError,
    SceneNotFoundError,
    SplatseedError,
)
from splatseed.io.files import ARCHIVE_FAILURES
from splatseed.io.staging import MANIFEST, atomic_file, output_folder, write_json
from splatseed.methods import Upsampler, chooses_number, configure
from splatseed.photos.view import user_cache_dir
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent
from splatseed.runtime.compilation import watched
from splatseed.runtime.memory import peak_bytes
from splatseed.runtime.tasks import Report, Workers, run_tasks
from splatseed.scene import Scene
from splatseed.scores import EvalResult
from splatseed.seeding.advice import DEFAULT_METHOD
from splatseed.seeding.clouds.method import Cloud
from splatseed.seeding.upsampling import thin_to, upsample
from splatseed.training.seeds import compared_images, stereo_size
from splatseed.training.settings import TrainSettings

if TYPE_CHECKING:  # PyTorch, which takes a while
    from splatseed.training.run import TrainingRun

_PICTURES = 3
"""Test views that are kept as pictures."""


@dataclass(frozen=True)
class JobOptions:
    """Options that do not affect the result: whether to keep models, and to measure LPIPS."""

    keep_models: bool = False
    lpips: bool = False


def do_runs(
    bench: Path,
    specs: Sequence[RunSpec],
    workers: Workers,
    options: JobOptions,
    away: bool = False,
    report: Report | None = None,
) -> Iterator[Run]:
    """Carry out unfinished runs; gives each as it ends. A failure is recorded, and ends no other.

    ``away`` is whether ``workers`` are elsewhere, so that folders come back as bytes; ``report`` is
    told how far each is, by its place in ``specs``.

    Raises:
        OutputError: The benchmark's folder cannot be written.
        KeyboardInterrupt: The user stopped them.
    """
    function = run_away if away else run_job
    calls = [(spec, options) if away else (spec, options, bench) for spec in specs]
    try:
        for ended in run_tasks(workers, function, calls, report):
            spec, value = specs[ended.index], ended.value
            if ended.error is not None:
                yield Run(spec, error=_keep_error(bench, spec, ended.error))
                continue
            if away:
                value, files = value
                _keep_files(bench, spec, files)
            yield Run(spec, value)
    except KeyboardInterrupt:
        for partial in (bench / "runs").glob(".*.partial-*"):  # of processes that were killed
            shutil.rmtree(partial, ignore_errors=True)
        raise


def _keep_error(bench: Path, spec: RunSpec, error: Exception) -> str:
    kind = "" if isinstance(error, SplatseedError) else f"{type(error).__name__}: "
    line, told = " ".join(f"{kind}{error}".split()), "".join(traceback.format_exception(error))
    text = json.dumps({"spec": spec.to_dict(), "error": line, "traceback": told}, indent=2) + "\n"
    with suppress(OutputError):  # as where the folder holds the user's files: the line tells
        _keep_files(bench, spec, {ERROR: text.encode("utf-8", "backslashreplace")})
    return line


def _keep_files(bench: Path, spec: RunSpec, files: Mapping[str, bytes]) -> None:
    with output_folder(run_folder(bench, spec), kind="bench", overwrite=True) as folder:
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)


def run_job(
    spec: RunSpec, options: JobOptions, bench: Path, progress: Progress = silent
) -> RunResult:
    """Carry out a run, and make its folder in the benchmark's."""
    from splatseed.splat.metrics import load_lpips  # noqa: PLC0415  (PyTorch)
    from splatseed.training.run import prepare_run  # noqa: PLC0415  (PyTorch)

    begun = time.perf_counter()
    with output_folder(run_folder(bench, spec), kind="bench", overwrite=True) as folder:
        progress("read", 0.0)
        scene = open_unchanged(spec.scene)
        lpips = load_lpips() if options.lpips else None
        seeds, seeding = make_seeds(scene, spec, progress, bench)
        every = spec.training.test_every
        images, backend = scene.split(every)[0], spec.settings.backend
        size = stereo_size(images, spec.settings, backend)
        count = len(compared_images(images, spec.settings, backend))
        # What stereo knows, for growth, is found once for all runs of a repeat, and its time counts
        # in each; not where seeds by auto have paid for it, as splatseed train shares the two.
        run = prepare_run(
            scene.replace(points=seeds),
            folder / "work",
            spec.settings,
            cache_dir=user_cache_dir(),
            depths=bench
            / "depths"
            / f"{spec.scene.digest}_{every}_{size}_{count}_{spec.repeat}.npz",
            seeding_knew=plain(spec.arm.method) == DEFAULT_METHOD and not _is_full(scene, spec),
            progress=progress,
        )
        if not run.train(lambda step: progress("train", step / spec.training.max_steps)):
            raise KeyboardInterrupt
        trained = run.finish(partial(_score, spec, bench, lpips, progress), progress)
        curve = tuple(point for point in trained.curve if math.isfinite(point.psnr))
        result = RunResult(
            trained.scores, curve, trained.num_seeds, seeding, trained.train_seconds, peak_bytes(),
            run.device, run.peak_gpu_bytes, wall_seconds=round(time.perf_counter() - begun, 3),
        )  # fmt: skip
        _keep(run, folder, models=options.keep_models)
        content = {"key": spec.key, "spec": spec.to_dict(), "result": result.to_dict()}
        write_json(folder / RESULT, content)
    return result


def run_away(spec: RunSpec, options: JobOptions) -> tuple[RunResult, dict[str, bytes]]:
    """Carry out a run on a node of a cluster, and return the files of its folder by name."""
    host, here = socket.gethostname(), package_version("splatseed")
    if here != spec.version:
        same, fix = f"splatseed {spec.version} on the node {host}", "Install it on every node."
        raise ParameterError(same, found=here or "none", fix=fix)
    if not Path(spec.scene.path).exists():
        fix = "Every node must have the scenes at the same path: share the disk, or copy them."
        there = f"the scene {spec.scene.path} on the node {host}"
        raise SceneNotFoundError(there, found="no such folder", fix=fix)
    with tempfile.TemporaryDirectory(prefix="splatseed-", ignore_cleanup_errors=True) as temporary:
        result = run_job(spec, options, Path(temporary))
        folder = run_folder(Path(temporary), spec)
        paths = [path for path in folder.rglob("*") if path.is_file() and path.name != MANIFEST]
        return result, {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def _keep(run: TrainingRun, folder: Path, *, models: bool) -> None:
    """Move what is kept out of the folder of training, and remove the rest.

    The pictures are of views spread evenly over the test views, so the same ones for every arm.
    """
    files = [run.folder.metrics, run.folder.config, run.folder.curve_csv]
    files += [run.folder.gaussians] if models else []
    pictures = sorted(run.folder.renders.iterdir())
    count = min(_PICTURES, len(pictures))
    files += [pictures[(2 * i + 1) * len(pictures) // (2 * count)] for i in range(count)]
    (folder / run.folder.renders.name).mkdir()
    for path in files:
        shutil.move(path, folder / path.relative_to(run.folder.path))
    shutil.rmtree(run.folder.path)


def _score(
    spec: RunSpec,
    bench: Path,
    lpips: Any,
    progress: Progress,
    render: Any,
    views: Sequence[Any],
    on_view: Any,
) -> EvalResult:
    """Score test views, also over the pixels that two training views see.

    These are computed once per scene; it is opened anew for that, so that an arm's depth maps make
    no difference.
    """
    from splatseed.splat import covisible  # noqa: PLC0415  (PyTorch)
    from splatseed.splat.evaluate import evaluate_views  # noqa: PLC0415  (PyTorch)

    every = spec.training.test_every
    kept = bench / "covisible" / f"{spec.scene.digest}_{every}.npz"
    grids = covisible.read_covisible(kept)
    if grids is None:
        grids = covisible.find_covisible(open_scene(replace(spec.scene, depth="")), every, progress)
        covisible.write_covisible(kept, grids)
    seen = covisible.pixel_masks(grids, views)
    return evaluate_views(
        render, views, lpips=lpips, covisible=seen, on_view=on_view, progress=progress
    )


def open_unchanged(facts: SceneFacts) -> Scene:
    """A scene before upsampling, with the depth maps that it names.

    Raises:
        SceneNotFoundError: It, or its depth maps, are not where they should be.
        SceneFormatError: It cannot be read, or has changed, or is different on this node.
    """
    scene = open_scene(facts)
    now = fingerprints(scene, facts.depth, facts.cloud)
    if now != {name: getattr(facts, name) for name in now}:
        expected = f"the files of {facts.path} as they were when the benchmark was planned"
        fix = "Start the benchmark again, which plans anew; or put them back."
        raise SceneFormatError(expected, found="others", fix=fix)
    return scene


def make_seeds(
    scene: Scene, spec: RunSpec, progress: Progress = silent, bench: Path | None = None
) -> tuple[PointCloud, float]:
    """The points that a run on a scene trains from, and the seconds that new ones took.

    Points made from photographs, which took a minute or more and which budgets and strategies thin,
    are kept in the benchmark's folder, if that is given. Their seconds count in each of these runs.
    """
    arm, most, seed = spec.arm, spec.most_seeds, spec.repeat
    if arm.method == SFM and most is None:
        return scene.points, 0.0
    method, numbers = _asked(scene, spec)
    make = partial(_timed, upsample, scene, method, **numbers, seed=seed, progress=progress)
    looks = arm.method != SFM and chooses_number(plain(arm.method))
    if bench is None or not looks or _is_full(scene, spec):
        seeds, seconds = make(budget=most)
        return seeds.select(seeds.distinct), seconds
    # Its key is that of a run whose settings of training do not matter.
    key = replace(spec, arm=replace(arm, strategy="none", budget=""), training=TrainSettings()).key
    path = bench / "seeds" / f"{key}.npz"
    if (made := _read_seeds(path)) is None:
        made = make()
        _write_seeds(path, *made)
    seeds, seconds = made
    if most is not None:
        seeds, more = _timed(thin_to, scene, seeds, most, method, seed, progress)
        seconds += more
    return seeds.select(seeds.distinct), seconds


def _timed(make: Callable[..., PointCloud], *args: Any, **named: Any) -> tuple[PointCloud, float]:
    """Points, and the seconds that making them took without compiling kernels."""
    compiling, running = 0.0, list[float]()

    def watch(begins: bool) -> None:
        nonlocal compiling
        if begins:
            running.append(time.perf_counter())
            return
        begun = running.pop()
        if not running:  # else it is nested in another, which counts it
            compiling += time.perf_counter() - begun

    with watched(watch):
        start = time.perf_counter()
        cloud = make(*args, **named)
        return cloud, max(time.perf_counter() - start - compiling, 0.0)


def _num_original(scene: Scene) -> int:
    return int(np.count_nonzero(scene.points.originals.distinct))


def _is_full(scene: Scene, spec: RunSpec) -> bool:
    """Whether ``auto`` makes no points, as the originals fill the budget."""
    most = spec.most_seeds
    return spec.arm.method == DEFAULT_METHOD and most is not None and _num_original(scene) >= most


def _asked(scene: Scene, spec: RunSpec) -> tuple[Upsampler, dict[str, Any]]:
    """The method of a run, and how many points it should make or what comes before it.

    Under a budget, a method without a ratio fills the room that the originals leave.
    """
    arm, most, begin = spec.arm, spec.most_seeds, f"{CLOUD}."
    if arm.method == SFM:  # no points are to be made: any method would do
        return configure("linear"), {"ratio": 1.0}
    if arm.method == CLOUD:
        return Cloud(**spec.parameters).of(spec.scene.cloud), {}
    own = {name: v for name, v in spec.parameters.items() if not name.startswith(begin)}
    method = configure(plain(arm.method), arm.profile, **own)
    if arm.method in WITH_CLOUD:
        cloud = {n.removeprefix(begin): v for n, v in spec.parameters.items() if n not in own}
        return method, {"extra_method": Cloud(**cloud).of(spec.scene.cloud)}
    if chooses_number(arm.method):
        return method, {}
    if arm.ratio or most is None:
        return method, {"ratio": arm.ratio}
    return method, {"num_points": most} if most > _num_original(scene) else {"ratio": 1.0}


def _write_seeds(path: Path, cloud: PointCloud, seconds: float) -> None:
    own = {"xyz": cloud.xyz, "rgb": cloud.rgb, "source": cloud.source}
    arrays: dict[str, Any] = {**own, **cloud.attributes, "seconds": np.float64(seconds)}
    with atomic_file(path) as partial, partial.open("wb") as file:
        np.savez(file, **arrays)


def _read_seeds(path: Path) -> tuple[PointCloud, float] | None:
    """The points that ``_write_seeds`` stored; None if nothing can be read."""
    try:
        with np.load(path, allow_pickle=False) as kept:
            arrays = dict(kept)
            seconds = float(arrays.pop("seconds"))
            return PointCloud(**arrays), seconds
    except (*ARCHIVE_FAILURES, PointCloudError):
        return None
