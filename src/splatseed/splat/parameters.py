"""Parameters of other programs' models: those that are not read, and values in other units.

3DGS stores logits of opacities and logarithms of sizes. Some exporters store opacities from 0 to 1
and sizes as lengths, under the same names. Both are recognised by their values: a trained model has
opacities below and above 1/2, so that logits have both signs and exceed 1, and most of its sizes
are similar to the spacing of its Gaussians. What can be either is refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from scipy.spatial import KDTree

from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.progress import Note
from splatseed.sampling import strided
from splatseed.text import agreeing

FOREIGN_KINDS = {
    "f_anchor_feat": "anchors (as of Scaffold-GS), from which networks generate Gaussians",
    "f_offset": "anchors (as of Scaffold-GS), from which networks generate Gaussians",
    "trbf_": "Gaussians that move and fade over time (as of Spacetime Gaussians)",
    "motion_": "Gaussians that move over time (as of Spacetime Gaussians)",
    "scaling_t": "Gaussians in space and time (4D Gaussian Splatting)",
    "scale_t": "Gaussians in space and time (4D Gaussian Splatting)",
    "sb_params": "Beta kernels (as of Deformable Beta Splatting), not Gaussians",
    "beta": "Beta kernels (as of Deformable Beta Splatting), not Gaussians",
    "sg_": "colours by spherical Gaussians, not by harmonics alone",
    "f_asg": "colours computed by a network (as of Spec-Gaussian)",
    "features": "features, from which a network computes colours",
}
"""Prefixes of parameters of models that only their own program can render."""
_SHOWN = 8
_ROUNDING = 1e-3  # activated opacities may leave 0 to 1 by this
_LARGEST_LOGIT = 30.0
"""Logits of a trainer stay below it: in float32, opacities are 1 from about 17 on."""
_MIN_COUNT = 20  # of Gaussians whose values show their unit
_VISIBLE = 0.3  # the largest opacity of a model that shows anything is above it
_MIN_RANGE = 0.7  # of opacities of a trained model, between 0 and 1
_MAX_ZEROS = 0.01  # share of activated opacities that are exactly 0, which a sigmoid never gives
_SAMPLE = 2000  # Gaussians whose spacing is measured
_CERTAIN = 4.0
"""Factor by which one reading of sizes must be closer to the spacing than the other."""


def check_parameters(path: Path, names: Iterable[str], known: Iterable[str], note: Note) -> None:
    """Report parameters that are not read, by name.

    Raises:
        SceneFormatError: One shows a model that is not drawn by Gaussians and harmonics alone.
    """
    others = sorted(set(names) - set(known))
    for name in others:
        for start, kind in FOREIGN_KINDS.items():
            if name.startswith(start):
                raise SceneFormatError(
                    f"{path} to hold trained Gaussians in 3DGS's layout",
                    found=f"{kind}: {name}",
                    fix="Export it as plain Gaussians with the program that trained it.",
                )
    groups: dict[str, list[str]] = {}
    for name in others:
        groups.setdefault(re.sub(r"_?\d+$", "", name), []).append(name)
    if groups:
        listed = [
            each[0] if len(each) == 1 else f"{stem} ({len(each)})" for stem, each in groups.items()
        ]
        text = f"{path} also has {', '.join(listed[:_SHOWN])}"
        text += f" and {len(listed) - _SHOWN} more" if len(listed) > _SHOWN else ""
        text += ", which splatseed neither renders nor writes: if colours or shapes depend on "
        text += f"{agreeing(len(others), 'it', 'them')}, renders and scores are wrong."
        note(Finding("unread-parameters", text, subjects=tuple(others)))


def in_standard_units(
    path: Path,
    means: Float32[np.ndarray, "N 3"],
    scales: Float32[np.ndarray, "N K"],
    opacities: Float32[np.ndarray, " N"],
    note: Note,
) -> tuple[Float32[np.ndarray, "N K"], Float32[np.ndarray, " N"]]:
    """Return log-scales and logits; sizes as lengths and opacities from 0 to 1 are converted.

    Raises:
        SceneFormatError: Values may be in either unit.
    """
    found = []
    with np.errstate(divide="ignore", invalid="ignore"):
        if _are_lengths(path, means, scales):
            found.append("sizes as lengths, not as logarithms")
            scales = np.log(scales)
        if _are_activated(path, opacities):
            found.append("opacities from 0 to 1, not as logits")
            clipped = np.clip(opacities, 0, 1)
            opacities = np.log(clipped / (1 - clipped))
    if found:
        text = f"{path} stores {' and '.join(found)}: they were converted."
        note(Finding("converted-values", text, subjects=(str(path),)))
    return scales, opacities


def _are_activated(path: Path, opacities: Float32[np.ndarray, " N"]) -> bool:
    values = opacities[~np.isnan(opacities)]
    if not len(values) or values.min() < -_ROUNDING:
        return False
    low, high = float(values.min()), float(values.max())
    if high > 1 + _ROUNDING:
        if len(values) >= _MIN_COUNT and np.isfinite(high) and high > _LARGEST_LOGIT:
            raise _uncertain(path, f"opacities from {low:.3g} to {high:.3g}", "their logits")
        return False  # such as a model without its faint Gaussians
    if len(values) < _MIN_COUNT or high < _VISIBLE:
        return (
            False  # logits near 0, opacities of 1/2, as some trainers start: else none would show
        )
    if high - low < _MIN_RANGE or (values == 0).mean() > _MAX_ZEROS:
        found = f"opacities from {low:.3g} to {high:.3g}, which may be logits or not"
        raise _uncertain(path, found, "logits, log(o / (1 - o)), of which some are negative")
    return True


def _are_lengths(
    path: Path, means: Float32[np.ndarray, "N 3"], scales: Float32[np.ndarray, "N K"]
) -> bool:
    usable = np.isfinite(scales).all(axis=1) & np.isfinite(means).all(axis=1)
    if not usable.any() or (scales[~np.isnan(scales)] < 0).any():
        return False
    sizes, xyz = scales[usable].astype(np.float64), means[usable].astype(np.float64)
    if len(xyz) < _MIN_COUNT:
        return False
    spacing = np.median(KDTree(xyz).query(strided(xyz, _SAMPLE), k=2)[0][:, 1])
    typical = float(np.median(np.median(sizes, axis=1)))
    if not spacing > 0:
        return False
    # How far each reading is from the spacing, as a logarithm.
    as_logarithms = abs(typical - np.log(spacing))
    as_lengths = abs(np.log(max(typical, 1e-30)) - np.log(spacing))
    if abs(as_logarithms - as_lengths) < np.log(_CERTAIN):
        found = f"sizes from {sizes.min():.3g} to {sizes.max():.3g}, logarithms or lengths"
        raise _uncertain(path, found, "logarithms of lengths")
    return bool(as_lengths < as_logarithms)


def _uncertain(path: Path, found: str, wanted: str) -> SceneFormatError:
    return SceneFormatError(
        f"{path} to store logits of opacities and logarithms of sizes, as 3DGS does",
        found=found,
        fix=f"Export it again with {wanted}.",
    )
