"""Test views: the photograph, renders of the baseline and the best variant, and their errors.

Notation: runs keep a few test views as pictures, with photograph, render and error map in a row
(see ``splatseed.splat.pictures``). Promise: both renders are of the same repeat; the best variant
is chosen by mean gain on the scene, not by the view that is shown.
"""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from splatseed.bench.analysis.gains import gains
from splatseed.bench.analysis.study import BASELINE, Study, Variant
from splatseed.bench.running.kept import kept_folder
from splatseed.errors import SplatseedError
from splatseed.io.photograph import decode_photograph, photograph_bytes
from splatseed.splat.pictures import GAP
from splatseed.train.settings import StrategyName

VIEWS = 2
"""Views shown per scene and strategy; one if there are several strategies."""
SIDE = 960
QUALITY = 85


class ComparedView(NamedTuple):
    """A test view and its renders.

    Pictures are JPEG by name, ordered so that neighbours are worth comparing.
    """

    scene: str
    strategy: StrategyName
    name: str
    best: Variant
    gain: float
    pictures: dict[str, bytes]
    shape: float
    """Width over height."""


def compared_views(study: Study, strategy: StrategyName, bench: Path) -> Iterator[ComparedView]:
    """The views that can be shown of each scene; none where the runs' pictures are gone.

    Args:
        study: The study.
        strategy: One of its strategies.
        bench: The benchmark's folder.
    """
    gained = gains(study, strategy)
    most = VIEWS if len(study.strategies) == 1 else 1
    for scene in gained.scenes:
        best = gained.top(scene)
        if best is None:
            continue
        folders = _folders(study, strategy, scene, best, bench)
        if folders is None:
            continue
        gain = gained.on_scene[scene, best].mean
        for name in _common(*folders)[:most]:
            pictures = _pictures(folders[0] / name, folders[1] / name, best)
            if pictures is not None:
                yield ComparedView(scene, strategy, Path(name).stem, best, gain, *pictures)


def _folders(
    study: Study, strategy: StrategyName, scene: str, best: Variant, bench: Path
) -> tuple[Path, Path] | None:
    """Where the pictures of baseline and best lie, of the least repeat that has both."""
    base, own = (study.cell(strategy, scene, each) for each in (BASELINE, best))
    for repeat in sorted(base.keys() & own.keys()):
        keys = [study.key(strategy, scene, each, repeat) for each in (BASELINE, best)]
        first, second = (kept_folder(bench, key or "") / "renders" for key in keys)
        if _common(first, second):
            return first, second
    return None


def _common(first: Path, second: Path) -> list[str]:
    """Names of pictures that both folders have."""
    names = ({path.name for path in folder.glob("*.png")} for folder in (first, second))
    return sorted(set.intersection(*names))


def _pictures(base: Path, own: Path, best: Variant) -> tuple[dict[str, bytes], float] | None:
    """The pictures of a view and their shape.

    None where they cannot be read or do not fit together.
    """
    try:
        parts = [_apart(path) for path in (base, own)]
    except SplatseedError:
        return None
    if parts[0] is None or parts[1] is None or parts[0][0].shape != parts[1][0].shape:
        return None
    (photograph, base_render, base_error), (_, own_render, own_error) = parts[0], parts[1]
    shown = {
        BASELINE.label: base_render,
        best.label: own_render,
        "photograph": photograph,
        f"error of {BASELINE.label}": base_error,
        f"error of {best.label}": own_error,
    }
    height, width = photograph.shape[:2]
    return {label: jpeg(pixels) for label, pixels in shown.items()}, width / height


def _apart(path: Path) -> list[UInt8[np.ndarray, "H W 3"]] | None:
    """Photograph, render and error map of a picture that has them in a row."""
    pixels = np.asarray(decode_photograph(path, photograph_bytes(path)))
    width, rest = divmod(pixels.shape[1] - 2 * GAP, 3)
    if rest or width < 1:
        return None
    return [pixels[:, i * (width + GAP) : i * (width + GAP) + width] for i in range(3)]


def jpeg(pixels: UInt8[np.ndarray, "H W 3"], side: int = SIDE) -> bytes:
    """A picture as JPEG, downsampled if its longer side exceeds ``side``.

    Args:
        pixels: The picture.
        side: The most pixels of its longer side.
    """
    from PIL import Image  # noqa: PLC0415  (slow to import)

    picture = Image.fromarray(np.ascontiguousarray(pixels))
    picture.thumbnail((side, side), Image.Resampling.LANCZOS)
    out = BytesIO()
    picture.save(out, "JPEG", quality=QUALITY, optimize=True)
    return out.getvalue()
