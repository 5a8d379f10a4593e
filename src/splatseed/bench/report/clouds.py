"""Pictures of the seeds of each method, from one camera.

Promise: seeds are recomputed exactly as in the runs (the same scene, parameters and seed), and only
if the scene's files are unchanged; else a sentence says why there is no picture.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from splatseed.bench.analysis.study import BASELINE, Study, Variant
from splatseed.bench.planning.digest import scene_digest
from splatseed.bench.planning.records import RunSpec
from splatseed.bench.report.figures import shown_variants
from splatseed.bench.running.seeds import make_seeds, scene_of
from splatseed.errors import SceneFormatError
from splatseed.progress import Progress, silent
from splatseed.scene import Scene

MOST = 10
"""Clouds in a picture."""


def seed_specs(study: Study, scene: str) -> dict[Variant, RunSpec]:
    """A run of each variant of a scene whose seeds to show: the one with the lowest repeat.

    Args:
        study: The study.
        scene: One of its scenes.
    """
    specs: dict[Variant, RunSpec] = {}
    for row in sorted(study.rows[scene], key=lambda row: row.spec.repeat):
        specs.setdefault(study.variant_of_key[row.spec.key], row.spec)
    shown = shown_variants(sorted(specs.keys() - {BASELINE}, key=lambda each: each.order))
    return {variant: specs[variant] for variant in shown[:MOST]}


def open_unchanged(specs: Sequence[RunSpec]) -> Scene:
    """The scene of runs, with depth maps if any of them needs these.

    Args:
        specs: Runs of one scene, at least one.

    Raises:
        SceneNotFoundError: It is no longer there.
        SceneFormatError: It cannot be read, or has changed.
    """
    spec = next((each for each in specs if each.depth_path), specs[0])
    scene = scene_of(spec)
    folder = scene.source.image_dir if scene.source else None
    if folder is None or scene_digest(scene, folder) != spec.scene_digest:
        raise SceneFormatError(
            f"the files of {spec.scene_path} as they were when the runs were made",
            found="other points, cameras or photographs",
            fix="Put them back to see pictures of its points.",
        )
    return scene


def cloud_picture(
    scene: Scene,
    specs: Mapping[Variant, RunSpec],
    progress: Progress = silent,
    bench: Path | None = None,
) -> bytes:
    """A PNG of the photograph, the originals and each variant's seeds.

    Args:
        scene: As ``open_unchanged`` gives it.
        specs: As ``seed_specs`` gives them.
        progress: Told the stages of upsampling.
        bench: The benchmark's folder, where points may be kept that took long to make.

    Raises:
        SplatseedError: As ``splatseed.upsample``.
    """
    from splatseed.view.clouds import preview_methods  # noqa: PLC0415  (Numba and Pillow)

    clouds = {
        variant.label: make_seeds(scene, spec, progress, bench)[0]
        for variant, spec in specs.items()
    }
    progress("draw points", 0.0)
    with tempfile.TemporaryDirectory() as folder:
        return preview_methods(scene, clouds, Path(folder) / "clouds.png").read_bytes()
