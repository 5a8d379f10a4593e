"""Bytes that a change of form must not change: points, depth maps and trained Gaussians.

    python -m benchmarks.golden_bytes record FILE.json
    python -m benchmarks.golden_bytes check FILE.json [--only PREFIX ...]

Run ``record`` before a redesign and ``check`` after each of its steps, on the same machine: bytes
do not depend on threads, but they do on the processor's vectors. What is hashed is what users get:
every method's points on fern and fox for seed 0 in both profiles, ``auto`` within a budget, 200
steps of every strategy on the CPU, and stereo's maps of fern with and without its points.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

import splatseed as ss
from splatseed.cli import main
from splatseed.depth.stereo import stereo_depths
from splatseed.io import load_scene
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene

METHODS = ("linear", "triangle", "spline", "mls", "voronoi", "random")
STRATEGIES = ("default", "grow", "mcmc", "none", "default-3dgs", "mcmc-3dgs", "none-3dgs")


def of_arrays(*arrays: np.ndarray) -> str:
    """The hash of arrays, their types and shapes."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def of_cloud(cloud: PointCloud) -> str:
    """The hash of a cloud's positions, colours and sources."""
    return of_arrays(cloud.xyz, cloud.rgb, cloud.source)


def of_maps(scene: Scene) -> str:
    """The hash of all stereo maps of a scene."""
    maps = stereo_depths(scene, seed=0)
    return of_arrays(*(np.asarray(m.depth) for m in maps))


def trained(scene: Path, strategy: str) -> str:
    """The hash of the Gaussians of 200 steps."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        words = f"train {scene} -o {run} --strategy {strategy} --max-steps 200 --budget 20000"
        # Auto's seeds would hide the scene's; 3DGS's own conventions take the scene's, too.
        words += " --seeds scene --long-side 400 --backend cpu --seed 0"
        main(words.split())  # exits by itself if it fails
        (ply,) = run.rglob("point_cloud.ply")
        return hashlib.sha256(ply.read_bytes()).hexdigest()[:16]


def without_points(scene: Scene) -> Scene:
    """The same photographs and poses, and no points."""
    nothing = scene.points.select(np.zeros(len(scene.points), bool))
    return scene.replace(points=nothing, tracks=None)


def cases(scenes: Path) -> Iterator[tuple[str, Callable[[], str]]]:
    """What is hashed, by name."""
    fern, fox = (ss.load_scene(scenes / name) for name in ("fern", "fox"))
    for name, scene in (("fern", fern), ("fox", fox)):
        for profile in ("default", "paper"):
            for method in METHODS:
                yield (
                    f"points/{name}/{profile}/{method}",
                    lambda s=scene, m=method, p=profile: of_cloud(
                        ss.upsample(s, method=m, ratio=4, seed=0, profile=p)
                    ),
                )
        for method in ("cover", "stereo", "auto"):
            yield (
                f"points/{name}/{method}",
                lambda s=scene, m=method: of_cloud(ss.upsample(s, method=m, seed=0)),
            )
        yield (
            f"points/{name}/auto-budget",
            lambda s=scene: of_cloud(ss.upsample(s, budget=8_000, seed=0)),
        )
        yield (
            f"points/{name}/mls-cover",
            lambda s=scene: of_cloud(ss.upsample(s, method="mls", ratio=4, seed=0, cover=8)),
        )
    room = load_scene(scenes / "replica" / "room0", require_points=False)
    yield ("points/room0/auto", lambda: of_cloud(ss.upsample(room, budget=8_000, seed=0)))
    yield "stereo/fern", lambda: of_maps(fern)
    bare = without_points(fern)
    yield "stereo/fern-without-points", lambda: of_maps(bare)
    yield (
        "points/fern-without-points/auto",
        lambda: of_cloud(ss.upsample(bare, budget=8_000, seed=0)),
    )
    for strategy in STRATEGIES:
        yield f"train/fern/{strategy}", lambda s=strategy: trained(scenes / "fern", s)


def run(arguments: list[str]) -> int:
    """Record the hashes, or say which differ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("action", choices=("record", "check"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--only", nargs="*", default=("",), help="prefixes of names")
    parser.add_argument("--scenes", type=Path, default=Path("../shared/scenes"))
    asked = parser.parse_args(arguments)
    known = json.loads(asked.file.read_text("utf-8")) if asked.file.exists() else {}
    chosen = [case for case in cases(asked.scenes) if case[0].startswith(tuple(asked.only))]
    if not chosen:
        parser.error(f"no name begins with {' or '.join(asked.only)}")
    different = 0
    for name, make in chosen:
        found = make()
        if asked.action == "record":
            known[name] = found
            asked.file.write_text(json.dumps(known, indent=1), "utf-8")
        same = known.get(name) == found
        different += not same
        print(f"{'same' if same else 'DIFFERENT'}  {name}  {found}", flush=True)
    return min(different, 1)


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
