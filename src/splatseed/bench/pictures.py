"""Pictures of a report: the seeds of each method from one camera, and test views of the best arm.

Seeds equal those of the runs. A scene is opened only for pictures that no earlier report drew; a
missing or changed scene has none.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from splatseed.bench.comparisons import baseline_of, rivals
from splatseed.bench.figures import shown_seeds
from splatseed.bench.job import check_versions, make_seeds, open_unchanged
from splatseed.bench.plan import RunSpec
from splatseed.bench.runs import run_folder
from splatseed.bench.statistics import Difference
from splatseed.bench.study import Study
from splatseed.errors import SplatseedError
from splatseed.findings import Finding
from splatseed.io.files import read_file
from splatseed.io.photograph import decode_photograph, photograph_bytes
from splatseed.progress import Progress, silent
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scene import Scene
from splatseed.splat.pictures import split_comparison
from splatseed.viewer.clouds import preview_methods

FIGURES = "figures"
_MAX_CLOUDS = 10  # in a picture
_SIDE, _CLOUD_SIDE = 960, 1800


@dataclass
class ScenePictures:
    """Pictures of a study's scenes: file name without suffix and PNG; findings on missing ones."""

    clouds: dict[str, tuple[str, bytes]] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)


def scene_pictures(bench: Path, study: Study, progress: Progress = silent) -> ScenePictures:
    """Draw the seeds of a study's scenes; read pictures that an earlier report drew."""
    pictures = ScenePictures()
    for scene in study.scenes:
        runs = study.runs[study.runs["scene"] == scene].sort_values("repeat", kind="stable")
        first = runs.drop_duplicates("seeds").set_index("seeds")["spec"].to_dict()
        shown = shown_seeds(study, [label for label in study.seeded if label in first])
        specs: dict[str, RunSpec] = {label: first[label] for label in shown[:_MAX_CLOUDS]}
        if _add_drawn(pictures, bench, scene, specs):
            continue
        current = {label: spec for label, spec in specs.items() if _is_current(spec)}
        if earlier := ", ".join(label for label in specs if label not in current):
            text = f"{scene}: no picture of points by earlier code: {earlier}"
            pictures.findings.append(Finding("missing-picture", text, subjects=(scene,)))
        if not current or _add_drawn(pictures, bench, scene, current):
            continue
        facts = [spec.scene for spec in current.values()]
        try:
            opened = open_unchanged(next((scene for scene in facts if scene.depth), facts[0]))
            drawn = _draw_seeds(opened, current, progress, bench)
            pictures.clouds[scene] = _picture_name(scene, current), drawn
        except SplatseedError as error:
            text = f"{scene}: no picture of its points: {error}"
            pictures.findings.append(Finding("missing-picture", text, subjects=(scene,)))
    return pictures


def _picture_name(scene: str, specs: Mapping[str, RunSpec]) -> str:
    digest = next(iter(specs.values())).scene.digest
    content = [digest, *((label, spec.key) for label, spec in specs.items())]
    key = fingerprint(json.dumps(content).encode())[:16]
    return re.sub(r"[^\w.-]+", "_", f"clouds_{scene}_{key}")  # the scene's name may have slashes


def _add_drawn(
    pictures: ScenePictures, bench: Path, scene: str, specs: Mapping[str, RunSpec]
) -> bool:
    """Add a picture that an earlier report drew; returns whether there is one, or none to draw."""
    if not specs:
        return True
    name = _picture_name(scene, specs)
    with suppress(OSError):
        pictures.clouds[scene] = name, read_file(bench / FIGURES / f"{name}.png")
    return scene in pictures.clouds


def _is_current(spec: RunSpec) -> bool:
    """Whether the code that made a run is still there, to make its seeds again."""
    with suppress(SplatseedError):
        check_versions(spec)
        return True
    return False


def _draw_seeds(
    scene: Scene, specs: Mapping[str, RunSpec], progress: Progress, bench: Path
) -> bytes:
    seeds = {label: make_seeds(scene, spec, progress, bench)[0] for label, spec in specs.items()}
    progress("draw points", 0.0)
    with tempfile.TemporaryDirectory() as folder:
        return preview_methods(scene, seeds, Path(folder) / "clouds.png").read_bytes()


def cloud_jpeg(png: bytes) -> bytes:
    """Convert a picture of seeds to a small JPEG for the page."""
    with Image.open(BytesIO(png)) as picture:
        return _jpeg(np.asarray(picture.convert("RGB")), _CLOUD_SIDE)


class ComparedView(NamedTuple):
    """A test view of a scene, as rendered by the baseline and by the best arm.

    ``gain`` is that of the best arm on the scene, in dB. ``pictures`` and ``errors`` (FLIP maps)
    are JPEGs by name; ``shape`` is their aspect ratio.
    """

    scene: str
    name: str
    gain: Difference
    pictures: Mapping[str, bytes]
    errors: Mapping[str, bytes]
    shape: float


def compared_views(study: Study, bench: Path) -> list[ComparedView]:
    """Choose a view per scene for which both runs have renders, in order of gain."""
    base, views = baseline_of(study), []
    best = next(iter(rivals(study)), None)
    if base is None or best is None:
        return []
    specs = study.runs.set_index(["strategy", "seeds", "scene", "repeat"])["spec"].to_dict()
    for scene, gain in best.on_scene.items():
        for repeat in sorted(study.runs["repeat"].unique()):
            both = [specs.get((*arm, scene, repeat)) for arm in (base, best.arm)]
            folders = [run_folder(bench, spec) / "renders" for spec in both if spec is not None]
            names = [{path.name for path in folder.glob("*.png")} for folder in folders]
            if len(folders) == 2 and (shared := sorted(set.intersection(*names))):
                name = shared[len(shared) // 2]
                paths = {base.label: folders[0] / name, best.arm.label: folders[1] / name}
                if (drawn := _pictures(paths)) is not None:
                    views.append(ComparedView(scene, Path(name).stem, gain, *drawn))
                break
    return views


def _pictures(paths: Mapping[str, Path]) -> tuple[dict[str, bytes], dict[str, bytes], float] | None:
    """Read the pictures, error maps and aspect ratio of a view; None if any is unusable."""
    try:
        parts = {label: _split(path) for label, path in paths.items()}
    except SplatseedError:
        return None
    if len({part.shape for part in parts.values()}) > 1:
        return None
    photograph = next(iter(parts.values()))[0]
    shown = {label: part[1] for label, part in parts.items()} | {"photograph": photograph}
    pictures = {label: _jpeg(pixels, _SIDE) for label, pixels in shown.items()}
    errors = {label: _jpeg(part[2], _SIDE // 2) for label, part in parts.items()}
    return pictures, errors, photograph.shape[1] / photograph.shape[0]


def _split(path: Path) -> UInt8[np.ndarray, "3 H W 3"]:
    """Split a picture into the photograph, render and error map that it has side by side."""
    return split_comparison(np.asarray(decode_photograph(path, photograph_bytes(path))))


def _jpeg(pixels: UInt8[np.ndarray, "H W 3"], side: int) -> bytes:
    """Encode a picture as JPEG, downsampled to ``side`` pixels if it is larger."""
    picture = Image.fromarray(np.ascontiguousarray(pixels))
    picture.thumbnail((side, side), Image.Resampling.LANCZOS)
    out = BytesIO()
    picture.save(out, "JPEG", quality=85, optimize=True)
    return out.getvalue()
