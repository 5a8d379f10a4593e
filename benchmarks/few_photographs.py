"""Few photographs: the benchmark of the literature on LLFF, and validation views to choose by.

The protocol is RegNeRF's (Niemeyer et al., 2022), which FSGS, DNGaussian and others kept: of a
scene's photographs at an eighth of their size, sorted by name, every eighth is tested; of the
others, n evenly spaced ones are trained on. Poses are LLFF's, with principal points at the centre.
Training has the poses alone, without points and depth maps, and the package's own defaults.

*Validation views* are photographs that are neither tested nor trained on, 16 at most, evenly
spaced. Other captures are always scored on them: their test photographs (every eighth, or those of
the capture's own list) are left out before anything is trained. ``views.json`` beside a capture
names photographs to train on and to validate on; of such a capture nothing is left out.

Each run has its own process and, once finished, its own file, which is not repeated as long as the
photographs, the options and splatseed's source stay the same. Prints a table per number of views.

    python -m benchmarks.few_photographs --llff nerf_llff_data --views 3 6 9
    python -m benchmarks.few_photographs --captures fox dorm --views 3 6 9 12 --validation
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import tyro

import splatseed as ss
from benchmarks.common.children import call
from benchmarks.common.ledger import report
from benchmarks.common.machine import describe
from benchmarks.common.markdown import table
from splatseed.errors import ParameterError, SceneNotFoundError, SplatseedError
from splatseed.findings import Finding
from splatseed.io.files import read_json
from splatseed.io.llff import POSES
from splatseed.io.photograph import photographs_digest
from splatseed.io.photograph_checks import with_photographs
from splatseed.io.staging import write_json
from splatseed.pointcloud import PointCloud
from splatseed.runtime.fingerprint import fingerprint
from splatseed.sampling import evenly_spaced
from splatseed.scene import Scene, Split
from splatseed.splat.lpips import has_lpips_weights
from splatseed.text import name_some

__all__ = ["run"]

SCENES = ("fern", "flower", "fortress", "horns", "leaves", "orchids", "room", "trex")
PHOTOGRAPHS = "images_8"
TEST_EVERY = 8
MOST_VALIDATED = 16
COLUMNS = {
    "psnr": ("PSNR, dB", ".2f"), "ssim": ("SSIM", ".3f"), "lpips": ("LPIPS (VGG)", ".3f"),
    "seconds": ("s", ".0f"), "processor": ("CPU s", ".0f"),
    "seeds": ("seeds", ",.0f"), "gaussians": ("Gaussians", ",.0f"),
}  # fmt: skip
"""Titles and formats of a result's numbers."""
Result = dict[str, Any]


@dataclass(frozen=True)
class Options:
    """What to train on, and what to score."""

    llff: Path | None = None
    """The folder nerf_llff_data, as it is downloaded."""
    scenes: tuple[str, ...] = ()
    """Some of its scenes; by default the benchmark's eight, as far as they are there."""
    captures: tuple[Path, ...] = ()
    """Other captures, of any format, to be scored on validation views."""
    views: tuple[int, ...] = (3, 6, 9)
    """Numbers of photographs to train on."""
    validation: bool = False
    """Score validation views instead of test photographs, as always those of other captures."""
    repeats: int = 1
    """Runs of each, with seeds 0, 1, ..."""
    max_steps: int | None = None
    """Training steps; by default the package's."""
    long_side: int | None = None
    """Most pixels on a photograph's longer side; by default the package's."""
    jobs: int = 1
    """Runs at a time, which share the cores."""
    output: Path = Path("few_photographs")
    """Folder of the results."""

    @property
    def validates(self) -> bool:
        """Whether validation views are scored, and no test photographs."""
        return self.validation or self.llff is None


class Case(NamedTuple):
    """A capture, and which of its photographs have a part."""

    name: str
    folder: Path
    views: int
    split: Split
    digest: str  # of the photographs and their poses


def main(options: Options) -> None:
    """Run what is not there yet, and print the tables."""
    if (options.llff is None) == (not options.captures):
        raise ParameterError("`--llff` or `--captures`", found="both or neither", fix="Name one.")
    cases = {views: _cases(options, views) for views in options.views}
    of_source, seeds = partial(_result, options, _source_digest()), range(options.repeats)
    with ThreadPoolExecutor(options.jobs) as pool:
        wanted = [(case, seed) for seed in seeds for each in cases.values() for case in each]
        list(pool.map(of_source, *zip(*wanted, strict=True)))
    print(f"{describe()}\n")
    for views, each in cases.items():
        runs = [[of_source(case, seed) for seed in seeds] for case in each]
        steps = name_some(sorted({f"{result['steps']:,}" for row in runs for result in row}))
        scored = "validation" if options.validates else "test"
        print(f"### {views} photographs, {scored} views; {steps} steps, {options.repeats} run(s)\n")
        rows = [[case.name, *_cells([row])] for case, row in zip(each, runs, strict=True)]
        rows.append([f"mean of {len(rows)}", *_cells(runs)])
        print(table(["scene", *(title for title, _ in COLUMNS.values())], rows) + "\n")


def _cells(runs: Sequence[Sequence[Result]]) -> list[str]:
    """Means over scenes and seeds; scores ± the standard deviation over seeds.

    Args:
        runs: Of each scene, the results by seed.
    """
    cells = []
    for name, (_, form) in COLUMNS.items():
        if any(each[name] is None for row in runs for each in row):
            cells.append("not installed")
            continue
        by_seed = [statistics.mean(each[name] for each in seed) for seed in zip(*runs, strict=True)]
        spread = len(by_seed) > 1 and not form.endswith(".0f")
        error = f" ± {statistics.stdev(by_seed):{form}}" if spread else ""
        cells.append(f"{statistics.mean(by_seed):{form}}{error}")
    return cells


def _cases(options: Options, views: int) -> list[Case]:
    """The captures, and the photographs of each that have a part with so many views."""
    if options.llff is None:
        folders = {"/".join(each.resolve().parts[-2:]): each for each in options.captures}
    else:
        folders = {name: _eighth(options.llff / name, options.output) for name in _names(options)}
    cases = []
    for name, folder in folders.items():
        scene = _read(folder)
        split = choose(scene, views, validation=options.validates, listed=_listed(folder))
        digest = photographs_digest(_with_split(scene, split))
        cases.append(Case(name, folder, views, split, digest))
    return cases


def _names(options: Options) -> Sequence[str]:
    assert options.llff is not None  # noqa: S101
    found = sorted(path.parent.name for path in options.llff.glob(f"*/{POSES}"))
    names = options.scenes or [each for each in SCENES if each in found] or found
    if not names or not {*names} <= {*found}:
        expected = f"{name_some(names) or 'scenes'} in {options.llff}, each with {POSES}"
        fix = "Name the folder that holds the folders of the scenes."
        raise SceneNotFoundError(expected, found=name_some(found) or "none", fix=fix)
    return names


def _eighth(scene: Path, output: Path) -> Path:
    """A folder of links to the poses and the small photographs alone.

    In the data set's folder, COLMAP's model and the full photographs would be read first.
    """
    folder = output / "scenes" / f"{scene.name}-{fingerprint(str(scene.resolve()))[:8]}"
    folder.mkdir(parents=True, exist_ok=True)
    for each in (POSES, PHOTOGRAPHS):
        if not (scene / each).exists():
            fix = "Download the scene again: its photographs at an eighth of their size count."
            raise SceneNotFoundError(f"{each} in {scene}", found="none", fix=fix)
        with suppress(FileExistsError):
            (folder / each).symlink_to((scene / each).resolve())
    return folder


def _read(folder: Path) -> Scene:
    """A capture's photographs and poses alone."""
    scene = with_photographs(ss.load_scene(folder, require_points=False))
    images = tuple(replace(image, observations=None) for image in scene.images)
    return scene.replace(points=PointCloud.empty(), tracks=None, depths=None, images=images)


def _listed(folder: Path) -> Mapping[str, Any] | None:
    """What ``views.json`` beside a capture says about it, if anything."""
    path = folder.resolve().parent / "views.json"
    return read_json(path).get(folder.resolve().name) if path.is_file() else None


def choose(
    scene: Scene, views: int, *, validation: bool, listed: Mapping[str, Any] | None = None
) -> Split:
    """Choose the photographs to train on and those to score.

    Args:
        scene: The scene, with all photographs.
        views: How many to train on.
        validation: Whether to score validation views instead of the test photographs.
        listed: Training and validation views by their number of the former, of a capture without
            its test photographs.

    Raises:
        ParameterError: The scene has too few photographs.
    """
    if listed and (chosen := listed.get(str(views))):
        return Split(frozenset(chosen["train"]), frozenset(chosen["validate"]), "views.json")
    others, tests = ([image.name for image in part] for part in scene.split(TEST_EVERY))
    if listed:
        others, tests = sorted([*others, *tests]), []
    train = [others[i] for i in evenly_spaced(len(others), views)]
    rest = [name for name in others if name not in {*train}]
    scored = [rest[i] for i in evenly_spaced(len(rest), MOST_VALIDATED)] if validation else tests
    if not 1 <= views == len(train) or not scored:
        expected = f"1 to {len(others) - validation} views of {scene.source.root}"
        raise ParameterError(expected, found=str(views), fix="Leave the capture or the number out.")
    return Split(frozenset(train), frozenset(scored), "protocol")


def _with_split(scene: Scene, split: Split) -> Scene:
    """The scene with the photographs that have a part, and no others."""
    names = sorted(split.train | split.test)
    return scene.replace(images=tuple(scene[name] for name in names), absent=(), listed=split)


def _source_digest() -> str:
    root = Path(ss.__file__).parent
    files = sorted(each for each in root.rglob("*") if each.suffix in {".py", ".pyi"})
    return fingerprint(*(part for each in files for part in (each.name, each.read_bytes())))


def _result(options: Options, state: str, case: Case, seed: int) -> Result:
    """A run's result, from its file if there is one."""
    given = {"seed": seed, "max_steps": options.max_steps, "long_side": options.long_side}
    chosen = {name: value for name, value in given.items() if value is not None}
    names = {"train": sorted(case.split.train), "scored": sorted(case.split.test)}
    key = fingerprint(state, case.digest, names, chosen, has_lpips_weights())
    path = options.output / f"{Path(case.name).name}_{case.views}_{seed}_{key[:16]}.json"
    if not path.is_file():
        report(f"{case.name}, {case.views} photographs, seed {seed} ...")
        result = call(
            "benchmarks.few_photographs:run", threads=max(1, (os.cpu_count() or 1) // options.jobs),
            folder=str(case.folder), options=chosen, **names,
        )  # fmt: skip
        if _source_digest() != state:
            fix = "Run it again; finished runs of this source are kept."
            raise SplatseedError("splatseed's source as it was", found="changes", fix=fix)
        options.output.mkdir(parents=True, exist_ok=True)
        write_json(path, {"scene": case.name, "views": case.views, **chosen, **names, **result})
        report(f"  {result['psnr']:.2f} dB, {result['seconds']:.0f} s")
    return read_json(path)


def run(folder: str, train: list[str], scored: list[str], options: dict[str, Any]) -> Result:
    """Train on some photographs of a capture, and score others.

    Seconds are those of ``ss.train``: of seeds, steps and scores.
    """
    split = Split(frozenset(train), frozenset(scored), "protocol")
    scene, found = _with_split(_read(Path(folder)), split), list[Finding]()
    with tempfile.TemporaryDirectory() as work:
        wall, processor = time.perf_counter(), sum(os.times()[:4])
        trained = ss.train(scene, Path(work) / "run", note=found.append, **options)
        seconds, processor = time.perf_counter() - wall, sum(os.times()[:4]) - processor
        metrics = trained.metrics
        lpips = ss.evaluate(trained, scene).lpips if has_lpips_weights() else None
    return {
        "psnr": metrics["psnr"], "ssim": metrics["ssim"], "lpips": lpips,
        "seconds": seconds, "processor": processor, "steps": metrics["steps"],
        "seeds": metrics["num_seeds"], "gaussians": metrics["num_gaussians"],
        "per_image": {each["name"]: (each["psnr"], each["ssim"]) for each in metrics["per_image"]},
        "findings": [f"{each.kind}: {each}" for each in found],
    }  # fmt: skip


if __name__ == "__main__":
    try:
        main(tyro.cli(Options, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
