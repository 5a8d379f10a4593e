"""A scan to seeds: seconds and peak memory of ``splatseed upsample --cloud`` for 100 M points.

A made room is scanned: points even on its surfaces, 2 mm of noise, 1% ghosts (half of them strewn
through the room, half in three clusters), turned, and moved to a national grid. It is
photographed from 100 places. The command runs in a process of its own, as a user would run it.

    python -m benchmarks.scale.scan WORK                       # 100 M points, 500k seeds
    python -m benchmarks.scale.scan WORK --limit 2000000       # a try

What is made in WORK (LAZ, about 11 bytes per point, and the scene) is kept and used again.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import laspy
import numpy as np
import tyro
from benchmarks.common.machine import describe, warn_if_busy
from benchmarks.common.markdown import table

from splatseed.io import load_scene
from splatseed.similarity import Similarity
from splatseed.synthetic.capture import Capture, make_capture, write_capture

__all__: list[str] = []

NOISE = 0.002
GHOSTS = 0.01
CLUSTERS, CLUSTER = 3, 0.06
CHUNK = 1_000_000
OFFSET = np.array([564_000.0, 5_932_000.0, 87.0])
TURN = np.radians(31.0)
MEMORY_TARGET, SECONDS_TARGET = 4.0, 900.0
GREY = 178
MAGENTA = (200, 30, 200)
CLOSE = 0.01
"""Seeds this near to a surface, in metres, are on it."""


@dataclass(frozen=True)
class Options:
    """Scan a made room, and turn the scan into seeds."""

    work: Annotated[Path, tyro.conf.Positional]
    """Where files are made and kept."""
    limit: int = 100_000_000
    """Points of the scan."""
    budget: str = "500k"
    """Seeds."""
    views: int = 100
    """Photographs."""
    width: int = 800
    """Their width in pixels; their height is three quarters of it."""


def grid_from_room() -> Similarity:
    """From the room to the national grid that it was scanned in."""
    cosine, sine = np.cos(TURN), np.sin(TURN)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return Similarity(1.0, rotation, OFFSET)


def scanned(capture: Capture, limit: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Points in the room and their colours, chunk by chunk."""
    rng = np.random.default_rng(1)
    parts, textures = capture.room.surfaces.parts, capture.room.textures
    share = np.array([part.area for part in parts])
    share /= share.sum()
    low, high = np.array([-1.4, -1.4, 0.1]), np.array([1.4, 1.4, 1.4])
    middles = rng.uniform(low, high, (CLUSTERS, 3))
    for start in range(0, limit, CHUNK):
        num = min(CHUNK, limit - start)
        ghosts = round(GHOSTS * num)
        counts = rng.multinomial(num - ghosts, share)
        sampled = [part.sample(count, rng) for part, count in zip(parts, counts, strict=True)]
        painted = [texture(xyz) for texture, xyz in zip(textures, sampled, strict=True)]
        strewn = rng.uniform(low, high, (ghosts - ghosts // 2, 3))
        cluster = middles[rng.integers(0, CLUSTERS, ghosts // 2)]
        cluster = cluster + rng.normal(0.0, CLUSTER, cluster.shape)
        xyz = np.concatenate([*sampled, strewn, cluster])
        rgb = np.clip(np.rint(GREY * np.concatenate(painted)), 0, 255)
        rgb = np.concatenate([rgb, np.tile(MAGENTA, (ghosts, 1))]).astype(np.uint16)
        order = rng.permutation(num)
        yield (xyz + rng.normal(0.0, NOISE, xyz.shape))[order], rgb[order] * 257


def write_scan(path: Path, capture: Capture, limit: int) -> None:
    """The scan as LAZ, in the national grid."""
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 0.0001), OFFSET
    with laspy.open(path, mode="w", header=header) as writer:
        for xyz, rgb in scanned(capture, limit):
            record = laspy.ScaleAwarePointRecord.zeros(len(xyz), header=header)
            record.x, record.y, record.z = grid_from_room().points(xyz).T
            record.red, record.green, record.blue = rgb.T
            writer.write_points(record)


def run(command: list[str]) -> tuple[float, float, float, str]:
    """Wall seconds, CPU seconds and peak gigabytes of a command, and what it printed."""
    start = time.perf_counter()
    timed = [sys.executable, "-c", MEASURE, *command]
    done = subprocess.run(timed, capture_output=True, text=True, check=False)
    wall = time.perf_counter() - start
    if done.returncode:
        raise SystemExit(done.stderr[-2000:])
    cpu, peak = json.loads(done.stdout.splitlines()[-1])
    return wall, cpu, peak, done.stdout


MEASURE = """
import json, resource, subprocess, sys
done = subprocess.run(sys.argv[1:])
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps([used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e9]))
sys.exit(done.returncode)
"""


def main(options: Options) -> None:
    """Make what is missing, run, and print a table."""
    warn_if_busy()
    options.work.mkdir(parents=True, exist_ok=True)
    capture = make_capture(0, options.views, options.width, options.width * 3 // 4)
    scene, scan = (
        options.work / f"scene_{options.views}_{options.width}",
        options.work / f"scan_{options.limit}.laz",
    )
    if not scene.exists():
        write_capture(capture, scene)
    if not scan.exists():
        partial = scan.with_suffix(".partial.laz")
        write_scan(partial, capture, options.limit)
        partial.rename(scan)
    transform = options.work / "room_from_grid.txt"
    np.savetxt(transform, np.vstack([grid_from_room().inverse.matrix, [0, 0, 0, 1]]))
    out = options.work / "seeds"
    command = [
        sys.executable, "-m", "splatseed", "upsample", str(scene), "--cloud", str(scan),
        "--transform", str(transform), "-o", str(out), "--budget", options.budget, "--overwrite",
    ]  # fmt: skip
    wall, cpu, peak, printed = run(command)
    seeds = load_scene(out).points
    new = seeds.select(seeds.source != 0)
    off = np.abs(capture.surfaces.distance(new.xyz.astype(np.float64)))
    stages = re.search(r"seconds +(.*)", printed)
    print(describe())
    rows = [
        ("points", f"{options.limit:,}", ""),
        ("seeds", f"{len(seeds):,}", options.budget),
        ("seconds", f"{wall:.0f}", f"{SECONDS_TARGET:.0f}"),
        ("CPU seconds", f"{cpu:.0f}", ""),
        ("peak GB", f"{peak:.2f}", f"{MEMORY_TARGET:.0f}"),
        ("new seeds on a surface, within 1 cm", f"{np.mean(off <= CLOSE):.2%}", ""),
        ("farther than 5 cm: ghosts", f"{np.mean(off > 5 * CLOSE):.3%}", ""),
        ("stages", stages.group(1) if stages else "", ""),
    ]
    print(table(("", "measured", "target"), rows))


if __name__ == "__main__":
    main(tyro.cli(Options))
