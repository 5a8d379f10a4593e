"""Pictures of a report: each method's seeds from one camera, and test views of the best variant.

Seeds are made exactly as in the runs, and only if the scene's files are unchanged; a scene is
opened only for what an earlier report has not kept; if it is gone, only its pictures are missing.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from splatseed.bench.comparisons import gains
from splatseed.bench.figures import shown_seeds
from splatseed.bench.guidelines import Descriptors, describe
from splatseed.bench.job import make_seeds, open_unchanged
from splatseed.bench.plan import SFM, RunSpec
from splatseed.bench.runs import run_folder
from splatseed.bench.study import Study
from splatseed.errors import SplatseedError
from splatseed.io.files import read_file, read_text
from splatseed.io.photograph import decode_photograph, photograph_bytes
from splatseed.io.staging import write_json
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.train.settings import StrategyName
from splatseed.view.clouds import preview_methods

FIGURES = "figures"
_DESCRIPTORS = "descriptors.json"
_MOST = 10  # clouds in a picture
_SIDE, _CLOUD_SIDE = 960, 1800


@dataclass
class ScenePictures:
    """A study's scenes: descriptors, file name without suffix and PNG, and what is not shown."""

    described: dict[str, Descriptors] = field(default_factory=dict)
    clouds: dict[str, tuple[str, bytes]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def scene_pictures(bench: Path, study: Study, progress: Progress = silent) -> ScenePictures:
    """Descriptors and pictures of a study's scenes, kept or new."""
    pictures, kept = ScenePictures(), _kept_descriptors(bench)
    for scene in study.scenes:
        runs = study.runs[study.runs["scene"] == scene].sort_values("repeat", kind="stable")
        first = runs.drop_duplicates("seeds").set_index("seeds")["spec"].to_dict()
        shown = shown_seeds(study, [label for label in study.seeded if label in first])
        specs: dict[str, RunSpec] = {label: first[label] for label in shown[:_MOST]}
        any_run: RunSpec = runs["spec"].iloc[0]
        digest = any_run.scene.digest
        told = [digest, *((name, each.repeat, each.scene.depth_digest, each.version)
                          for name, each in specs.items())]  # fmt: skip
        key = hashlib.blake2b(json.dumps(told).encode(), digest_size=8).hexdigest()
        name = re.sub(r"[^\w.-]+", "_", f"clouds_{scene}_{key}")  # a scene's can have slashes
        with suppress(OSError):
            pictures.clouds[scene] = name, read_file(bench / FIGURES / f"{name}.png")
        try:
            if digest not in kept or (specs and scene not in pictures.clouds):
                facts = [spec.scene for spec in (*specs.values(), any_run)]
                opened = open_unchanged(next((each for each in facts if each.depth), facts[0]))
                if digest not in kept:
                    kept[digest] = describe(opened, progress)
                if specs and scene not in pictures.clouds:
                    pictures.clouds[scene] = name, _draw_seeds(opened, specs, progress, bench)
        except SplatseedError as error:
            pictures.notes.append(f"{scene}: its points are not shown or described: {error}")
        if digest in kept:
            pictures.described[scene] = kept[digest]
    if kept:  # JSON has no NaN: what is unknown is null
        described = {digest: {k: None if math.isnan(v) else v for k, v in each.items()}
                     for digest, each in kept.items()}  # fmt: skip
        write_json(bench / _DESCRIPTORS, described)
    return pictures


def _kept_descriptors(bench: Path) -> dict[str, Descriptors]:
    """The descriptors of an earlier report, by fingerprint; empty if there are none."""
    with suppress(OSError, ValueError, TypeError, AttributeError):
        content = json.loads(read_text(bench / _DESCRIPTORS))
        return {digest: {k: math.nan if v is None else float(v) for k, v in each.items()}
                for digest, each in content.items()}  # fmt: skip
    return {}


def _draw_seeds(
    scene: Scene, specs: Mapping[str, RunSpec], progress: Progress, bench: Path
) -> bytes:
    seeds = {label: make_seeds(scene, spec, progress, bench)[0] for label, spec in specs.items()}
    progress("draw points", 0.0)
    with tempfile.TemporaryDirectory() as folder:
        return preview_methods(scene, seeds, Path(folder) / "clouds.png").read_bytes()


def cloud_jpeg(png: bytes) -> bytes:
    """A picture of seeds as JPEG, small enough for a page."""
    from PIL import Image  # noqa: PLC0415  (slow to import)

    with Image.open(BytesIO(png)) as picture:
        return _jpeg(np.asarray(picture.convert("RGB")), _CLOUD_SIDE)


class ComparedView(NamedTuple):
    """A test view and its renders by baseline and best variant.

    Pictures are JPEG by name, ordered so that neighbours are worth comparing; ``shape`` is their
    width over their height, ``gain`` the best variant's on the scene, dB.
    """

    scene: str
    name: str
    best: str
    gain: float
    pictures: Mapping[str, bytes]
    shape: float


def compared_views(study: Study, strategy: StrategyName, bench: Path) -> Iterator[ComparedView]:
    """The views that can be shown of each scene; none where the runs' pictures are gone."""
    gained, part = gains(study, strategy), study.under(strategy)
    most = 2 if len(study.strategies) == 1 else 1
    specs = part.set_index(["scene", "seeds", "repeat"])["spec"].to_dict()
    for scene in gained.scenes:
        best = gained.top(scene)
        for repeat in sorted(part["repeat"].unique()):
            both = [specs.get((scene, label, repeat)) for label in (SFM, best)]
            folders = [run_folder(bench, spec) / "renders" for spec in both if spec is not None]
            names = [{path.name for path in folder.glob("*.png")} for folder in folders]
            if len(folders) == 2 and set.intersection(*names):
                gain = gained.on_scene[scene, best].mean
                for name in sorted(set.intersection(*names))[:most]:
                    pictures = _pictures(folders[0] / name, folders[1] / name, best)
                    if pictures is not None:
                        yield ComparedView(scene, Path(name).stem, best, gain, *pictures)
                break


def _pictures(base: Path, own: Path, best: str) -> tuple[dict[str, bytes], float] | None:
    """The pictures of a view and their shape; None where they cannot be read or do not fit."""
    try:
        parts = [_apart(path) for path in (base, own)]
    except SplatseedError:
        return None
    if parts[0].shape != parts[1].shape:
        return None
    (photograph, base_render, base_error), (_, own_render, own_error) = parts
    shown = {SFM: base_render, best: own_render, "photograph": photograph,
             f"error of {SFM}": base_error, f"error of {best}": own_error}  # fmt: skip
    height, width = photograph.shape[:2]
    return {label: _jpeg(pixels, _SIDE) for label, pixels in shown.items()}, width / height


def _apart(path: Path) -> UInt8[np.ndarray, "3 H W 3"]:
    """Photograph, render and error map of a picture that has them in a row."""
    from splatseed.splat.rendering import GAP  # noqa: PLC0415  (imports PyTorch)

    pixels = np.asarray(decode_photograph(path, photograph_bytes(path)))
    width = (pixels.shape[1] - 2 * GAP) // 3
    return np.stack([pixels[:, i * (width + GAP) :][:, :width] for i in range(3)])


def _jpeg(pixels: UInt8[np.ndarray, "H W 3"], side: int) -> bytes:
    """A picture as JPEG, downsampled if its longer side exceeds ``side``."""
    from PIL import Image  # noqa: PLC0415  (slow to import)

    picture = Image.fromarray(np.ascontiguousarray(pixels))
    picture.thumbnail((side, side), Image.Resampling.LANCZOS)
    out = BytesIO()
    picture.save(out, "JPEG", quality=85, optimize=True)
    return out.getvalue()
