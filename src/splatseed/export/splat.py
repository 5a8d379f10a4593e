"""The .splat of web viewers: 32 bytes per Gaussian, without view-dependent colour.

Notation: a record is float32 x, y, z and scales (standard deviations), then bytes: red, green,
blue, opacity, and the rotation wxyz as 128 q + 128. The file has no header; Gaussians are sorted by
size times opacity, so that a viewer can draw the most important ones first. Source:
antimatter15/splat.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatseed.export.packing import opacity_bytes, opacity_logits, unit_quats
from splatseed.io.files import ByteReader
from splatseed.splat.gaussians import SH_C0, Gaussians

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def encode(gaussians: Gaussians) -> bytes:
    """The bytes of a file with the Gaussians, the largest and most opaque first."""
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
    rows["quat"] = np.clip(np.rint(unit_quats(gaussians.quats[order]) * 128 + 128), 0, 255)
    return rows.tobytes()


def decode(path: Path) -> Gaussians:
    """The Gaussians in a file.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is not a whole number of records, or a scale is not above 0.
    """
    reader = ByteReader(path, "Copy the file again, or export it again.")
    reader.record = "Gaussians"
    rows = reader.array(RECORD, len(reader.data) // RECORD.itemsize)
    reader.finish()
    good = np.isfinite(rows["scale"]).all(axis=1) & (rows["scale"] >= 0).all(axis=1)
    if not len(rows) or not good.all():
        worst = f"{rows['scale'][np.argmin(good)]} in Gaussian {np.argmin(good)}"
        raise reader.error("scales of 0 or more", worst if len(rows) else "no Gaussian")
    least = np.finfo(np.float32).tiny
    return Gaussians(
        means=np.ascontiguousarray(rows["mean"], np.float32),
        scales=np.log(np.maximum(rows["scale"], least)).astype(np.float32),
        quats=unit_quats((rows["quat"].astype(np.float32) - 128) / 128),
        opacities=opacity_logits(rows["rgba"][:, 3]),
        sh0=((rows["rgba"][:, None, :3] / 255 - 0.5) / SH_C0).astype(np.float32),
        shN=np.zeros((len(rows), 0, 3), np.float32),
    )
