"""Carry out runs: make seeds, train, score, and write the run's folder, on this machine or on Ray.

A run's folder is written in one step. Seeds equal the output of ``splatseed upsample``, with
``--auto.no-dense`` under a budget, as arms of several budgets share them; their time excludes the
compilation of kernels. Runs share the files in ``BENCH/seeds``, ``depths`` and ``covisible``.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import socket
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from shutil import which
from typing import TYPE_CHECKING, Any

import numpy as np

from splatseed.bench.plan import CLOUD, SFM, WITH_CLOUD, RunResult, RunSpec, seeding_method
from splatseed.bench.runs import ERROR, RESULT, BenchRun, run_folder
from splatseed.bench.scenes import SceneFacts, fingerprints, open_scene
from splatseed.bench.versions import method_version, splatseed_version
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
from splatseed.photos.loading import user_cache_dir
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, StageTimes, num_threads, silent, watched
from splatseed.runtime.environment import worker_env
from splatseed.runtime.fingerprint import fingerprint
from splatseed.runtime.memory import peak_bytes
from splatseed.runtime.tasks import ProcessWorkers, Report, Workers, run_tasks
from splatseed.scene import Scene
from splatseed.scores import EvalResult
from splatseed.seeding.advice import DEFAULT_METHOD
from splatseed.seeding.clouds.method import Cloud
from splatseed.seeding.photo_methods import Stereo
from splatseed.text import counted
from splatseed.training.settings import Backend, TrainSettings

if TYPE_CHECKING:  # PyTorch, which takes a while
    from splatseed.training.run import TrainingRun


@dataclass(frozen=True)
class Machine:
    """The workers of a benchmark: how many ``jobs`` at a time, with ``threads`` CPU threads each.

    ``backend`` is not "auto"; ``remote`` workers are other machines, which return files as bytes.
    """

    backend: Backend
    jobs: int
    threads: int
    workers: Workers
    remote: bool = False

    @property
    def description(self) -> str:
        """The machine, for the user."""
        where = "Ray" if self.remote else "this machine"
        on = "on a GPU" if self.backend == "cuda" else "on the CPU"
        return f"{where}, {self.jobs} at a time, {on}, {counted(self.threads, 'thread')} each"


def local_machine(jobs: int | None, backend: Backend, progress: Progress = silent) -> Machine:
    """Choose processes on this machine; by default one per GPU, or one."""
    chosen: Backend = "cpu"
    driver = which("nvidia-smi") or which("rocminfo") or Path("/proc/driver/nvidia").exists()
    if backend == "cuda" or (backend == "auto" and driver):  # else PyTorch sees no GPU
        from splatseed.training.device import pick_device  # noqa: PLC0415  (PyTorch)

        # gsplat's kernels are built here, not by each run.
        chosen = "cuda" if pick_device(backend, progress).type == "cuda" else "cpu"
    gpus = [""]
    if chosen == "cuda":
        import torch  # noqa: PLC0415

        named = [each for each in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if each]
        gpus = named or [f"{i}" for i in range(torch.cuda.device_count())]
    jobs = jobs or len(gpus)
    threads = num_threads(jobs)
    slots = [worker_env(threads, gpus[slot % len(gpus)]) for slot in range(jobs)]
    return Machine(chosen, jobs, threads, ProcessWorkers(slots))


@contextmanager
def ray_machine(address: str | None, jobs: int | None, backend: Backend) -> Iterator[Machine]:
    """Connect to a Ray cluster; without an address, Ray starts on this machine."""
    from splatseed.runtime.ray_tasks import RayWorkers, ray_cluster  # noqa: PLC0415  (Ray)

    with ray_cluster(address):
        gpu = None if backend == "auto" else backend == "cuda"
        workers = RayWorkers(gpu=gpu, limit=jobs)
        chosen: Backend = "cuda" if workers.gpu else "cpu"
        yield Machine(chosen, workers.jobs, workers.threads, workers, remote=True)


@dataclass(frozen=True)
class RunOptions:
    """Options that do not affect the result: keep the trained Gaussians, measure LPIPS."""

    keep_models: bool = False
    lpips: bool = False


def execute_runs(
    bench: Path,
    specs: Sequence[RunSpec],
    machine: Machine,
    options: RunOptions,
    report: Report | None = None,
) -> Iterator[BenchRun]:
    """Carry out runs, and yield each as it ends; failed runs are recorded.

    ``report`` takes the index of a run in ``specs``, its stage, and the fraction that is done.

    Raises:
        KeyboardInterrupt: The user stopped the runs.
    """
    remote = machine.remote
    function = run_remotely if remote else run_job
    calls = [(spec, options) if remote else (spec, options, bench) for spec in specs]
    try:
        for ended in run_tasks(machine.workers, function, calls, report):
            spec, value = specs[ended.index], ended.value
            if ended.error is not None:
                yield BenchRun(spec, error=_record_error(bench, spec, ended.error))
                continue
            if remote:
                value, files = value
                _write_files(bench, spec, files)
            yield BenchRun(spec, value)
    except KeyboardInterrupt:
        for partial in (bench / "runs").glob(".*.partial-*"):  # of processes that were killed
            shutil.rmtree(partial, ignore_errors=True)
        raise


def _record_error(bench: Path, spec: RunSpec, error: Exception) -> str:
    kind = "" if isinstance(error, SplatseedError) else f"{type(error).__name__}: "
    line, trace = " ".join(f"{kind}{error}".split()), "".join(traceback.format_exception(error))
    text = json.dumps({"spec": spec.to_dict(), "error": line, "traceback": trace}, indent=2) + "\n"
    with suppress(OutputError):  # such as user files in the folder; the line reports it
        _write_files(bench, spec, {ERROR: text.encode("utf-8", "backslashreplace")})
    return line


def _write_files(bench: Path, spec: RunSpec, files: Mapping[str, bytes]) -> None:
    with output_folder(run_folder(bench, spec), kind="bench", overwrite=True) as folder:
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)


def run_job(
    spec: RunSpec, options: RunOptions, bench: Path, progress: Progress = silent
) -> RunResult:
    """Carry out a run, and write its folder."""
    from splatseed.splat.lpips import load_lpips  # noqa: PLC0415  (PyTorch)
    from splatseed.training.depths import DepthCache, placing_views  # noqa: PLC0415  (Numba)
    from splatseed.training.prepare import prepare_run  # noqa: PLC0415  (PyTorch)

    start = time.perf_counter()
    check_versions(spec)
    with output_folder(run_folder(bench, spec), kind="bench", overwrite=True) as folder:
        progress("read", 0.0)
        scene = open_unchanged(spec.scene)
        lpips = load_lpips() if options.lpips else None
        seeds, seeding = make_seeds(scene, spec, progress, bench)
        every = spec.training.test_every
        images, backend = scene.split(every)[0], spec.settings.backend
        views, size = placing_views(images, spec.settings, backend)
        # Runs of a repeat share the depths of stereo that growth needs, and each counts their time,
        # unless the seeds of auto have, as in splatseed train.
        run = prepare_run(
            scene.replace(points=seeds),
            folder / "work",
            spec.settings,
            cache_dir=user_cache_dir(),
            depth_cache=DepthCache(
                bench / "depths" / f"{_shared(spec)}_{size}_{len(views)}_{spec.repeat}.npz",
                seeding_method(spec.arm.method) == DEFAULT_METHOD and not _is_full(scene, spec),
            ),
            progress=progress,
        )
        if not run.train(lambda step: progress("train", step / spec.training.max_steps)):
            raise KeyboardInterrupt
        trained = run.finish(partial(_score, spec, bench, lpips, progress), progress)
        curve = tuple(point for point in trained.curve if math.isfinite(point.psnr))
        result = RunResult(
            trained.scores, curve, trained.num_seeds, seeding, trained.train_seconds, peak_bytes(),
            run.device, run.peak_gpu_bytes, wall_seconds=round(time.perf_counter() - start, 3),
        )  # fmt: skip
        _collect_files(run, folder, models=options.keep_models)
        content = {"key": spec.key, "spec": spec.to_dict(), "result": result.to_dict()}
        write_json(folder / RESULT, content)
    return result


def run_remotely(spec: RunSpec, options: RunOptions) -> tuple[RunResult, dict[str, bytes]]:
    """Carry out a run on a node of a cluster; returns the files of its folder by name."""
    if not Path(spec.scene.path).exists():
        fix = "Every node must have the scenes at the same path: share the disk, or copy them."
        expected = f"the scene {spec.scene.path} on the node {socket.gethostname()}"
        raise SceneNotFoundError(expected, found="no such folder", fix=fix)
    with tempfile.TemporaryDirectory(prefix="splatseed-", ignore_cleanup_errors=True) as temporary:
        result = run_job(spec, options, Path(temporary))
        folder = run_folder(Path(temporary), spec)
        paths = [path for path in folder.rglob("*") if path.is_file() and path.name != MANIFEST]
        return result, {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def check_versions(spec: RunSpec) -> None:
    """Check that the code of this process is that of the plan.

    Raises:
        ParameterError: It is not.
    """
    method = spec.arm.method
    own = "" if method == SFM else method_version(seeding_method(method))
    for what, planned, here in (
        ("splatseed", spec.version, splatseed_version()), (method, spec.method_version, own)
    ):  # fmt: skip
        if here != planned:
            raise ParameterError(
                f"{what} {planned} on {socket.gethostname()}, as it was when the benchmark was "
                "planned",
                found=here or "none",
                fix="Start the benchmark again to plan anew; all nodes of a cluster need one code.",
            )


def _shared(spec: RunSpec) -> str:
    """The name of files that runs of the same scene, split and code share."""
    code = fingerprint(spec.version.encode())[:8]
    return f"{spec.scene.digest}_{spec.training.test_every}_{code}"


def _collect_files(run: TrainingRun, folder: Path, *, models: bool) -> None:
    """Move the files to keep out of the training folder, and remove it.

    The render is kept of the middle test view, the same for every arm.
    """
    files = [run.folder.metrics, run.folder.config, run.folder.curve_csv]
    files += [run.folder.gaussians] if models else []
    pictures = sorted(run.folder.renders.iterdir())
    files += [pictures[len(pictures) // 2]]
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

    The pixels are computed once per scene, without an arm's depth maps.
    """
    from splatseed.splat import covisible  # noqa: PLC0415  (PyTorch)
    from splatseed.splat.evaluate import evaluate_views  # noqa: PLC0415  (PyTorch)

    every = spec.training.test_every
    cache = bench / "covisible" / f"{_shared(spec)}.npz"
    grids = covisible.read_covisible(cache)
    if grids is None:
        grids = covisible.find_covisible(open_scene(replace(spec.scene, depth="")), every, progress)
        covisible.write_covisible(cache, grids)
    masks = covisible.pixel_masks(grids, views)
    return evaluate_views(
        render, views, lpips=lpips, covisible=masks, on_view=on_view, progress=progress
    )


def open_unchanged(facts: SceneFacts) -> Scene:
    """Open a surveyed scene with its depth maps.

    Raises:
        SceneNotFoundError: The scene or its depth maps are missing.
        SceneFormatError: A file is invalid, or has changed since the survey.
    """
    scene = open_scene(facts)
    now = fingerprints(scene, facts.depth, facts.cloud)
    if now != {name: getattr(facts, name) for name in now}:
        expected = f"the files of {facts.path} as they were when the benchmark was planned"
        fix = "Start the benchmark again to plan anew, or restore the files."
        raise SceneFormatError(expected, found="changed files", fix=fix)
    return scene


def make_seeds(
    scene: Scene, spec: RunSpec, progress: Progress = silent, bench: Path | None = None
) -> tuple[PointCloud, float]:
    """Make the points from which a run trains; returns them with the time of new points in seconds.

    Arms that differ only in budget or strategy share points made from photographs, which take a
    minute or more: ``bench/seeds`` caches them with their time, which counts in each run.
    """
    from splatseed.seeding.thinning import thin_to  # noqa: PLC0415  (--help reads this module)
    from splatseed.seeding.upsampling import upsample  # noqa: PLC0415  (likewise)

    arm, limit, seed = spec.arm, spec.max_seeds, spec.repeat
    if arm.method == SFM and limit is None:
        return scene.points, 0.0
    method, size = _method_and_size(scene, spec)
    make = partial(_timed, upsample, scene, method, **size, seed=seed, progress=progress)
    uses_photos = arm.method != SFM and chooses_number(seeding_method(arm.method))
    if bench is None or not uses_photos or _is_full(scene, spec):
        seeds, seconds = make(budget=limit)
        return seeds.select(seeds.distinct), seconds
    # The key of a run with default training settings.
    key = replace(spec, arm=replace(arm, strategy="none", budget=""), training=TrainSettings()).key
    path = bench / "seeds" / f"{key}.npz"
    cached = _read_seeds(path)
    if cached is None:
        cached = make()
        _write_seeds(path, *cached)
    seeds, seconds = cached
    if limit is not None:
        seeds, thinning = _timed(thin_to, scene, seeds, limit, method, seed, progress)
        seconds += thinning
    return seeds.select(seeds.distinct), seconds


def _timed(make: Callable[..., PointCloud], *args: Any, **named: Any) -> tuple[PointCloud, float]:
    """Make points, and measure the time without the compilation of kernels, in seconds."""
    times = StageTimes()
    times("seeds", 0.0)
    with watched(times.compilation):
        cloud = make(*args, **named)
    return cloud, times.seconds()["seeds"]


def _num_original(scene: Scene) -> int:
    return int(np.count_nonzero(scene.points.originals.distinct))


def _is_full(scene: Scene, spec: RunSpec) -> bool:
    """Whether the original points fill the budget, so that ``auto`` adds none."""
    limit = spec.max_seeds
    return spec.arm.method == DEFAULT_METHOD and limit is not None and _num_original(scene) >= limit


def _method_and_size(scene: Scene, spec: RunSpec) -> tuple[Upsampler, dict[str, Any]]:
    """The method of a run, and the arguments of ``upsample`` for the number of points.

    Under a budget, a method without a ratio adds points until the budget is full.
    """
    arm, limit, prefix = spec.arm, spec.max_seeds, f"{CLOUD}."
    if arm.method == SFM:  # at ratio 1 every method returns the originals
        return configure("linear"), {"ratio": 1.0}
    if arm.method == CLOUD:
        return Cloud(**spec.parameters).of(spec.scene.cloud), {}
    own = {name: v for name, v in spec.parameters.items() if not name.startswith(prefix)}
    method = configure(seeding_method(arm.method), arm.profile, **own)
    if isinstance(method, Stereo):  # seeds are thinned to each budget, with and without a cache
        method = replace(method, dense=False)
    if arm.method in WITH_CLOUD:
        cloud = {n.removeprefix(prefix): v for n, v in spec.parameters.items() if n not in own}
        return method, {"extra_method": Cloud(**cloud).of(spec.scene.cloud)}
    if chooses_number(arm.method):
        return method, {}
    if arm.ratio or limit is None:
        return method, {"ratio": arm.ratio}
    return method, {"num_points": limit} if limit > _num_original(scene) else {"ratio": 1.0}


def _write_seeds(path: Path, cloud: PointCloud, seconds: float) -> None:
    points = {"xyz": cloud.xyz, "rgb": cloud.rgb, "source": cloud.source}
    arrays: dict[str, Any] = {**points, **cloud.attributes, "seconds": np.float64(seconds)}
    with atomic_file(path) as partial, partial.open("wb") as file:
        np.savez(file, **arrays)


def _read_seeds(path: Path) -> tuple[PointCloud, float] | None:
    """Read the points of ``_write_seeds``; None if there is no readable file."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = dict(archive)
            seconds = float(arrays.pop("seconds"))
            return PointCloud(**arrays), seconds
    except (*ARCHIVE_FAILURES, PointCloudError):
        return None
