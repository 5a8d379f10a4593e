"""What a report needs from the scenes themselves: descriptors, and pictures of the seeds.

Notation: cached results are in ``BENCH/descriptors.json`` and ``BENCH/figures``, whose
``clouds.json`` says which seeds each picture shows. Promise: a scene is opened only for what is not
cached; if it is gone or has changed, only its pictures are missing from the report.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from splatseed.bench.analysis.descriptors import (
    Descriptors,
    describe,
    read_descriptors,
    write_descriptors,
)
from splatseed.bench.analysis.study import Study, Variant
from splatseed.bench.planning.records import RunSpec
from splatseed.bench.report.clouds import cloud_picture, open_unchanged, seed_specs
from splatseed.errors import SplatseedError
from splatseed.io.files import read_file, read_text
from splatseed.progress import Progress, silent

FIGURES = "figures"
CLOUDS = "clouds.json"
KEPT_DESCRIPTORS = "descriptors.json"


@dataclass
class Pictures:
    """The pictures and descriptors of a study's scenes.

    Args:
        described: Descriptors by scene.
        clouds: PNG by scene.
        files: The name of each scene's PNG, without suffix.
        keys: What each PNG is of, by file name.
        notes: What could not be shown, one sentence each.
    """

    described: dict[str, Descriptors] = field(default_factory=dict)
    clouds: dict[str, bytes] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    keys: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def scene_pictures(
    bench: Path, study: Study, *, from_scenes: bool = True, progress: Progress = silent
) -> Pictures:
    """Descriptors and pictures of a study's scenes, cached or new.

    Args:
        bench: The benchmark's folder.
        study: The study.
        from_scenes: Whether scenes may be opened; else only what is kept is used.
        progress: Told the stages.

    Raises:
        OutputError: Descriptors cannot be kept.
    """
    pictures = Pictures()
    kept = read_descriptors(bench / KEPT_DESCRIPTORS)
    drawn = _drawn(bench)
    for scene in study.scenes:
        specs = seed_specs(study, scene)
        anyone = study.rows[scene][0].spec
        key = _key(anyone, specs)
        if anyone.scene_digest in kept:
            pictures.described[scene] = kept[anyone.scene_digest]
        if key in drawn:
            pictures.clouds[scene] = drawn[key]
        if from_scenes and (
            scene not in pictures.described or (specs and scene not in pictures.clouds)
        ):
            _look(pictures, scene, anyone, specs, bench, progress)
        if scene in pictures.clouds:
            pictures.files[scene] = f"clouds_{safe_name(scene)}_{key[:6]}"
            pictures.keys[pictures.files[scene]] = key
        if scene in pictures.described:
            kept[anyone.scene_digest] = pictures.described[scene]
    if kept:
        write_descriptors(bench / KEPT_DESCRIPTORS, kept)
    return pictures


def _look(
    pictures: Pictures,
    scene: str,
    anyone: RunSpec,
    specs: Mapping[Variant, RunSpec],
    bench: Path,
    progress: Progress,
) -> None:
    """Open a scene for what is not cached."""
    try:
        opened = open_unchanged([*specs.values(), anyone])
        if scene not in pictures.described:
            pictures.described[scene] = describe(opened, progress)
        if specs and scene not in pictures.clouds:
            pictures.clouds[scene] = cloud_picture(opened, specs, progress, bench)
    except SplatseedError as error:
        pictures.notes.append(f"{scene}: its points are not shown or described: {error}")


def _key(anyone: RunSpec, specs: Mapping[Variant, RunSpec]) -> str:
    """What a picture of seeds depends on."""
    told = [
        (variant.label, spec.repeat, spec.depth_digest, spec.version)
        for variant, spec in specs.items()
    ]
    text = json.dumps([anyone.scene_digest, told])
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _drawn(bench: Path) -> dict[str, bytes]:
    """Pictures of an earlier report by what they are of."""
    pictures = {}
    with suppress(OSError, ValueError, AttributeError):
        names = json.loads(read_text(bench / FIGURES / CLOUDS))
        for name, key in names.items():
            pictures[key] = read_file(bench / FIGURES / f"{Path(name).name}.png")
    return pictures


def safe_name(text: str) -> str:
    """A name as a part of a file's: letters, digits, dots, hyphens and underscores.

    Example:
        >>> safe_name("my kitchen/(ab12)")
        'my_kitchen_ab12_'
    """
    return re.sub(r"[^\w.-]+", "_", text)
