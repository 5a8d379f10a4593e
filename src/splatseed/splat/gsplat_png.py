"""Read gsplat's PNG compression: a folder with ``meta.json`` and an image per parameter.

Parameters have 8 bits between the bounds of each column, positions 16 bits of
sign(x) log(1 + |x|), harmonics a palette in an .npz; further parameters an .npz each.
Source: gsplat 1.5 (compression/png_compression.py).
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from PIL import Image

from splatseed.findings import Finding
from splatseed.io.files import read_bytes, translate_errors
from splatseed.progress import Note, silent_note
from splatseed.splat.gaussians import PARAMETERS, SH_COUNTS, Gaussians
from splatseed.splat.parameters import check_parameters

_COMPLETE = "a complete folder of gsplat's PNG compression"


def is_gsplat_png(meta: Any) -> bool:
    """Whether the content of a ``meta.json`` is gsplat's; SOG's names the files of its parts."""
    means = meta.get("means") if isinstance(meta, Mapping) else None
    return isinstance(means, Mapping) and "shape" in means and "files" not in means


def decode(path: Path, note: Note = silent_note) -> Gaussians:
    """Decode the folder of a ``meta.json``."""
    with translate_errors(path, _COMPLETE):
        meta = json.loads(read_bytes(path))
        check_parameters(path, meta, PARAMETERS, note)
        count = int(meta["means"]["shape"][0])
        low, high = (_pixels(path, f"means_{end}.png") for end in "lu")
        curved = _between(low.astype(np.uint16) | high.astype(np.uint16) << 8, 65535, meta["means"])
        values = {
            name: _between(_pixels(path, f"{name}.png"), 255, meta[name])
            for name in ("scales", "opacities", "sh0", "quats")
            if name in meta
        }
        if "quats" not in values:
            text = f"{path} has no rotations (quats): its Gaussians are read without, as the wrong "
            note(Finding("missing-rotations", f"{text}shapes.", "error", subjects=(str(path),)))
            values["quats"] = np.tile([1.0, 0, 0, 0], (count, 1))
        rest = np.zeros((count, 0))
        if "shN" in meta and all(meta["shN"]["shape"]):
            packed = np.load(io.BytesIO(read_bytes(path.parent / "shN.npz")), allow_pickle=False)
            full = 2 ** int(meta["shN"]["quantization"]) - 1
            rest = _between(packed["centroids"], full, meta["shN"])[packed["labels"].astype(int)]
        harmonics = rest.reshape(count, -1, 3)
        if harmonics.shape[1] not in SH_COUNTS:
            raise ValueError(f"{harmonics.shape[1]} harmonics beyond the first")
        arrays = {
            "means": (np.sign(curved) * np.expm1(np.abs(curved))).reshape(count, 3),
            "scales": values["scales"].reshape(count, 3),
            "quats": values["quats"].reshape(count, 4),
            "opacities": values["opacities"].reshape(count),
            "sh0": values["sh0"].reshape(count, 1, 3),
            "shN": harmonics,
        }
        return Gaussians(**{name: array.astype(np.float32) for name, array in arrays.items()})


def _pixels(meta: Path, name: str) -> np.ndarray:
    with Image.open(io.BytesIO(read_bytes(meta.parent / name))) as picture:
        pixels = np.asarray(picture)
    return pixels.reshape(pixels.shape[0] * pixels.shape[1], -1)


def _between(codes: np.ndarray, full: int, meta: Mapping[str, Any]) -> Float64[np.ndarray, "N C"]:
    """Return values between the bounds of their columns, or of all, from codes 0 to ``full``."""
    low, high = (np.asarray(meta[end], np.float64) for end in ("mins", "maxs"))
    return np.asarray(low + codes / full * (high - low))
