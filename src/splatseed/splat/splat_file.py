"""Read and write .splat files: 32 bytes per Gaussian, without header or view-dependent colour.

Source: antimatter15/splat.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatseed.findings import Finding
from splatseed.io.files import ByteReader
from splatseed.progress import Note, silent_note
from splatseed.splat.gaussians import SH_C0, Gaussians, antialiasing_finding
from splatseed.splat.packing import (
    clipped_findings,
    opacity_bytes,
    opacity_logits,
    rounded_bytes,
    unit_quats,
)

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
"""One Gaussian: scales are standard deviations, the rotation is 128 q + 128."""

_FIRST = (-0.5 / SH_C0, 0.5 / SH_C0)
"""First coefficients of colours from 0 to 1."""


def encode(gaussians: Gaussians, note: Note = silent_note) -> list[bytes]:
    """Encode Gaussians, sorted by size times opacity so that viewers can draw the largest first."""
    if gaussians.antialiased:
        note(antialiasing_finding("a .splat"))
    if gaussians.shN.size:
        text = "A .splat has no view-dependent colour: the model's is left out."
        note(Finding("unused-harmonics", text))
    for finding in clipped_findings(".splat", gaussians, first=_FIRST):
        note(finding)
    log_opacity = -np.logaddexp(0, -gaussians.opacities.astype(np.float64))
    size = gaussians.scales.astype(np.float64).sum(axis=1) + log_opacity
    order = np.argsort(-size, kind="stable")
    rows = np.empty(len(order), RECORD)
    rows["mean"] = gaussians.means[order]
    with np.errstate(over="ignore"):
        rows["scale"] = np.exp(gaussians.scales[order])
    color = 0.5 + SH_C0 * gaussians.sh0[order, 0]
    rows["rgba"][:, :3] = np.rint(np.clip(color, 0, 1) * 255)
    rows["rgba"][:, 3] = opacity_bytes(gaussians.opacities[order])
    rows["quat"] = rounded_bytes(unit_quats(gaussians.quats[order]) * 128 + 128)
    return [rows.tobytes()]


def decode(path: Path, _: Note = silent_note) -> Gaussians:
    """Decode a .splat; negative scales become NaN.

    As a .splat has no signature, a file is refused if half of its Gaussians or more lack usable
    means and scales.
    """
    reader = ByteReader(path)
    reader.record = "Gaussians"
    rows = reader.array(RECORD, len(reader.data) // RECORD.itemsize)
    reader.finish()
    usable = (np.isfinite(rows["scale"]) & (rows["scale"] >= 0)).all(axis=1)
    bad = np.count_nonzero(~(usable & np.isfinite(rows["mean"]).all(axis=1)))
    if 2 * bad >= len(rows):
        raise reader.error(
            "finite positions and scales", f"NaN, infinity or negative scales in {bad} Gaussians"
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        scales = np.log(rows["scale"])
    return Gaussians(
        means=np.ascontiguousarray(rows["mean"], np.float32),
        scales=scales.astype(np.float32),
        quats=unit_quats((rows["quat"].astype(np.float32) - 128) / 128),
        opacities=opacity_logits(rows["rgba"][:, 3]),
        sh0=((rows["rgba"][:, None, :3] / 255 - 0.5) / SH_C0).astype(np.float32),
        shN=np.zeros((len(rows), 0, 3), np.float32),
    )
