"""What ``splatseed info`` prints of trained Gaussians: a file, or the folder of a run.

With ``--json``, positions and sizes are in scene units, and five numbers are percentiles 5, 25, 50,
75 and 95.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from splatseed.console import add_results, print_next, print_note, print_pairs
from splatseed.findings import Finding
from splatseed.io.files import read_bytes
from splatseed.io.origin import format_offset, offset_beside
from splatseed.splat.formats import (
    FORMATS,
    detect_format,
    holds_gaussians,
    read_gaussians,
    unpacked_model,
)
from splatseed.splat.gaussians import VISIBLE_LOGIT, Gaussians
from splatseed.text import quoted
from splatseed.training.folder import RunFolder, config_of, model_file

PERCENTILES = (5, 25, 50, 75, 95)


def is_model(path: Path) -> bool:
    """Whether a path is a run, or a file of Gaussians."""
    if path.is_file():
        return holds_gaussians(path)
    return RunFolder(path).is_run or unpacked_model(path) is not None


def show_model(path: Path) -> None:
    """Print the count, the extent, and the sizes and opacities of a model's Gaussians."""
    file, findings = model_file(path), list[Finding]()
    gaussians = read_gaussians(file, findings.append)
    facts = {
        "format": detect_format(file, read_bytes(file)),
        "bytes": file.stat().st_size,
        **describe_gaussians(gaussians),
    }
    offset = offset_beside(file)
    facts["offset"] = None if offset is None else offset.tolist()
    add_results(**facts, notes=[str(each) for each in findings])
    middle, whole = (
        "  to  ".join(" ".join(f"{x:.4g}" for x in corner) for corner in facts[name])
        for name in ("extent", "bounding_box")
    )
    degree = facts["sh_degree"]
    kind = FORMATS[facts["format"]]
    rows = [
        ("format", f"{facts['format']} ({kind.description}), {facts['bytes'] / 1e6:.2f} MB"),
        ("Gaussians", f"{len(gaussians):,}"),
        ("SH degree", f"{degree}{'' if degree else ': no view-dependent colour'}"),
        *[("rendered", "antialiased")] * gaussians.antialiased,
        ("extent, 5 to 95%", f"{middle} (along each axis)"),
        ("bounding box", whole),
        ("opacity 5/25/50/75/95%", " ".join(f"{x:.3f}" for x in facts["opacity"])),
        ("fainter than 0.1", f"{facts['faint']:.0%}"),
        ("size 5/25/50/75/95%", " ".join(f"{x:.3g}" for x in facts["size"])
         + " (standard deviation along the longest axis)"),
        ("flat", f"{facts['flat']:.0%} (shortest axis under a tenth of the middle one)"),
    ]  # fmt: skip
    if offset is not None:
        rows.append(("offset", f"{format_offset(offset)}: before = after + offset"))
    print_pairs(str(path), rows)
    print_note(*findings)
    known = isinstance(config_of(path).get("scene"), str)
    scored = f"splatseed evaluate {quoted(path)}{'' if known else ' --scene SCENE'}"
    print_next([("look at it", f"splatseed view {quoted(path)}"), ("score it", scored)])


def describe_gaussians(gaussians: Gaussians) -> dict[str, Any]:
    """Return the facts about Gaussians, as ``--json`` prints them."""
    xyz = gaussians.means.astype(np.float64)
    opacity = 1.0 / (1.0 + np.exp(-gaussians.opacities.astype(np.float64)))
    axes = np.sort(gaussians.scales.astype(np.float64), axis=1)
    box = np.percentile(xyz, (5, 95), axis=0)
    return {
        "gaussians": len(gaussians),
        "sh_degree": gaussians.sh_degree,
        "antialiased": gaussians.antialiased,
        "bounding_box": [xyz.min(axis=0).tolist(), xyz.max(axis=0).tolist()],
        "extent": box.tolist(),
        "opacity": _percentiles(opacity),
        "faint": float((gaussians.opacities < VISIBLE_LOGIT).mean()),
        "size": _percentiles(np.exp(axes[:, 2])),
        "flat": float((axes[:, 0] < axes[:, 1] - np.log(10)).mean()),
    }


def _percentiles(values: Float[np.ndarray, " N"]) -> list[float]:
    return [float(each) for each in np.percentile(values, PERCENTILES)]
