"""How fast stereo is: a hypothesis beside a scalar loop, and a hundred views to seeds.

Notation: a *hypothesis* is one plane at one pixel, tried in five sources of 25 samples; seconds are
one thread's on a core. Promise: every measurement has a process of its own, which has compiled
before the clock starts; both cost functions are seen to give the same costs.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.common.clocks import Clock
from benchmarks.common.memory import status_bytes
from benchmarks.stereo.peer import costs_of_planes

import splatseed as ss
from splatseed.depth.stereo._kernels.patchmatch import QuadImages, initialise, red_black_sweep
from splatseed.depth.stereo.fusion import fuse
from splatseed.depth.stereo.maps import StereoSettings
from splatseed.depth.stereo.matching import make_quads
from splatseed.depth.stereo.pipeline import find_stereo
from splatseed.photos.loading import load_views
from splatseed.photos.visibility import find_visibility
from splatseed.pointcloud import PointCloud
from splatseed.synthetic import make_capture, write_capture
from splatseed.synthetic.texture import value_noise

__all__ = ["hypothesis_seconds", "prepare_views", "whole_run"]

WIDTH, HEIGHT, GRID, FOCAL = 800, 600, 4, 760.0
SOURCES, PLANES = 5, 11
"""A visit of PatchMatch tries as many planes: eight of neighbours, three changed at random."""
DEPTHS = (1.5, 4.0)
REPEATS = 5
NUM_VIEWS = 100
CELL = 4.0


def prepare_views(cache: Path) -> Path:
    """The made room on 100 photographs, made once."""
    folder = cache / f"room_{NUM_VIEWS}"
    if not folder.is_dir():
        write_capture(make_capture(0, NUM_VIEWS, WIDTH, HEIGHT), folder)
    return folder


def hypothesis_seconds(peer_rows: int) -> dict[str, float]:
    """Seconds of a hypothesis: alone, in a sweep, and of the peer, on the grid's first rows."""
    images, warps, guesses = _workload()
    quad_images = _quad_images(images, warps)
    shape = guesses.shape[2:]
    planes, costs = np.zeros((3, *shape), np.float32), np.empty(shape, np.float32)
    few = np.ascontiguousarray(guesses[:, :, :peer_rows])
    peer_costs = np.empty((PLANES, peer_rows, shape[1]), np.float32)
    seconds = {
        "planes": _best(lambda: initialise(quad_images, guesses, planes, costs))
        / guesses[:, 0].size,
        "sweep": _best(lambda: _sweeps(quad_images, planes, costs)) / guesses[:, 0].size,
        "peer": _best(
            lambda: costs_of_planes(images[0], images[1:], warps, GRID, few, peer_costs), 2
        ) / peer_costs.size,
    }  # fmt: skip
    initialise(quad_images, guesses[:1].copy(), planes, costs)
    gap = np.abs(costs[:peer_rows] - peer_costs[0])
    return {**seconds, "gap": float(gap[np.isfinite(gap)].max())}


def _sweeps(quad_images: QuadImages, planes: np.ndarray, costs: np.ndarray) -> None:
    for color in range(2):
        red_black_sweep(quad_images, color, 1, np.uint64(1), planes, costs)


def _workload() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grey images uint8 [6, H, W], warps [5, 3, 4], planes float32 [11, 3, h, w]."""
    rng = np.random.default_rng(0)
    row, column = np.indices((HEIGHT, WIDTH)).reshape(2, -1).astype(float)
    images = [
        value_noise(np.stack([column, row, 0 * row + 50 * i], axis=1) / 24, 4, 0).reshape(
            HEIGHT, WIDTH
        )
        for i in range(SOURCES + 1)
    ]
    warps = np.tile(np.eye(3, 4), (SOURCES, 1, 1))
    warps[:, :2, 3] = FOCAL * rng.uniform(-0.3, 0.3, (SOURCES, 2))
    warps[:, :2, 2] -= warps[:, :2, 3] / np.mean(DEPTHS)
    shape = (HEIGHT // GRID, WIDTH // GRID)
    w = 1 / np.mean(DEPTHS) * (1 + 0.3 * np.sin(np.arange(shape[1]) / 30))
    guesses = np.zeros((PLANES, 3, *shape), np.float32)
    guesses[:, 0] = w * rng.uniform(0.97, 1.03, (PLANES, *shape))
    guesses[:, 1:] = rng.normal(scale=0.2 / FOCAL, size=(PLANES, 2, *shape))
    return (255 * np.clip(images, 0, 1)).astype(np.uint8), warps, guesses


def _quad_images(images: np.ndarray, warps: np.ndarray) -> QuadImages:
    size = np.array([WIDTH, HEIGHT], np.int64)
    quads = [make_quads(image).ravel() for image in images]
    packed = np.array([[*warp[:, :3].ravel(), *warp[:, 3]] for warp in warps], np.float32)
    return QuadImages(
        quads[0], size, np.concatenate(quads[1:]), np.tile(size, (SOURCES, 1)),
        np.arange(SOURCES + 1) * WIDTH * HEIGHT, packed, GRID, FOCAL,
        np.array([0.5 / DEPTHS[1], 2 / DEPTHS[0]], np.float32),
    )  # fmt: skip


def _best(function: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Seconds of this thread on a core; the best of several, after one that compiles."""
    function()
    seconds = []
    for _ in range(repeats):
        started = time.thread_time()
        function()
        seconds.append(time.thread_time() - started)
    return min(seconds)


def whole_run(folder: str, clock: Clock, threads_used: int, *, points: bool) -> dict[str, Any]:
    """Seconds by stage of photographs to seeds, seeds, and the process's peak memory in bytes.

    Args:
        folder: The scene.
        clock: What seconds are.
        threads_used: By which processor time is divided.
        points: Whether its points are known beforehand.
    """
    scene = ss.load_scene(folder)
    if not points:
        scene = scene.replace(points=PointCloud.empty(), tracks=None)
    settings = StereoSettings(grid=GRID)
    few = scene.images[:2]
    fuse(
        find_stereo(load_views(scene, few), few, find_visibility(scene), settings), CELL
    )  # compiles
    read = time.perf_counter if clock == "wall" else lambda: time.process_time() / threads_used
    stages: dict[str, float] = {}
    last = read()

    def note(stage: str, _: float) -> None:
        nonlocal last
        now = read()
        stages[stage] = stages.get(stage, 0.0) + now - last
        last = now

    views = load_views(scene, scene.images, progress=note)
    stereo = find_stereo(views, scene.images, find_visibility(scene), settings, 0, note)
    seeds = fuse(stereo, CELL, note)
    return {"stages": stages, "seeds": len(seeds), "peak": status_bytes("VmHWM")}
