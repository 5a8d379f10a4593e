"""Read Gaussians from PyTorch checkpoints: of gsplat's, nerfstudio's and graphdeco's trainers.

gsplat's ``simple_trainer`` saves a dict ``splats`` of parameters, several GPUs one file each;
nerfstudio's splatfacto saves the state of its pipeline; graphdeco's ``--checkpoint_iterations`` a
tuple of its model's parameters. Their units are ours. Only tensors and plain containers are loaded,
never code. Sources: gsplat 1.5 (examples/simple_trainer.py), nerfstudio 1.1 (models/splatfacto.py),
graphdeco's scene/gaussian_model.py.
"""

from __future__ import annotations

import pickle
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io.files import translate_errors
from splatseed.progress import Note, silent_note
from splatseed.requirements import require
from splatseed.splat.background import recorded
from splatseed.splat.gaussians import PARAMETERS, SH_C0, SH_COUNTS, Gaussians
from splatseed.splat.parameters import check_parameters

SUFFIXES = (".ckpt", ".pt", ".pth")
_EXPECTED = "a checkpoint of gsplat's, nerfstudio's or graphdeco's trainer"
_NERFSTUDIO = re.compile(r"(?:^|\.)_model\.(?:gauss_params\.)?(\w+)$")
_NERFSTUDIO_NAMES = {"features_dc": "sh0", "features_rest": "shN"}
_GRAPHDECO = ("means", "sh0", "shN", "scales", "quats", "opacities")
"""Parameters in the order of graphdeco's tuple, after the degree of its harmonics."""
_RANK = re.compile(r"_rank\d+$")
_ANTIALIASED = {
    "config.yml": (r"^ *rasterize_mode: *(antialiased|classic)\b",),
    "cfg.yml": (r"^antialiased: *(true|false)\b",),
}


def decode(path: Path, note: Note = silent_note) -> Gaussians:
    """Decode a checkpoint; those of other GPUs beside it are added."""
    require("torch")
    files = [path]
    if _RANK.search(path.stem):
        stem = _RANK.sub("", path.stem)
        beside = path.parent.glob(f"{stem}_rank*{path.suffix}")
        files = sorted(file for file in beside if _RANK.sub("", file.stem) == stem)
    parts = [_parameters(file, note) for file in files]
    if len(files) > 1:
        text = f"The Gaussians of {len(files)} GPUs were read: {', '.join(f.name for f in files)}."
        note(Finding("joined-checkpoints", text, "info", subjects=tuple(map(str, files))))
    with translate_errors(path, _EXPECTED):
        values = {name: np.concatenate([part[name] for part in parts]) for name in PARAMETERS}
        mode = recorded(path, _ANTIALIASED)
        return Gaussians(
            **values, antialiased=mode is not None and mode[0].lower() in {"antialiased", "true"}
        )


def _parameters(path: Path, note: Note) -> dict[str, np.ndarray]:
    """Return the parameters of one file by our names and in our shapes."""
    found = _named(path, _loaded(path))
    check_parameters(path, found, PARAMETERS, note)
    missing = [name for name in PARAMETERS[:-1] if name not in found]
    if missing:
        raise SceneFormatError(
            f"{path} to be {_EXPECTED}",
            found=f"no {', '.join(missing)}",
            fix="Export it as .ply with the program that trained it.",
        )
    with translate_errors(path, _EXPECTED):
        values = {
            name: np.asarray(found[name].detach().float().numpy(), np.float32)
            for name in PARAMETERS
            if name in found
        }
        count = len(values["means"])
        values["opacities"] = values["opacities"].reshape(count)
        values["sh0"] = values["sh0"].reshape(count, 1, 3)
        rest = values.get("shN", np.empty((count, 0, 3), np.float32))
        if rest.shape[1] not in SH_COUNTS:
            raise ValueError(f"{rest.shape[1]} harmonics beyond the first")
        values["shN"] = rest
        if any(values[name].shape != (count, n) for name, n in (("scales", 3), ("quats", 4))):
            raise ValueError("sizes or rotations of another shape")
        return values


def _loaded(path: Path) -> Any:
    import torch  # noqa: PLC0415  (optional: extra `train`)

    with translate_errors(path, _EXPECTED), warnings.catch_warnings(action="ignore"):
        try:
            return torch.load(path, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError:
            raise SceneFormatError(
                f"{path} to be {_EXPECTED}",
                found="a damaged file, or objects other than tensors, which could run code",
                fix="Export it as .ply with the program that trained it.",
            ) from None


def _named(path: Path, content: Any) -> dict[str, Any]:
    """Return the tensors of a checkpoint by gsplat's names."""
    if isinstance(content, Sequence) and len(content) == 2 and isinstance(content[0], Sequence):
        return dict(zip(_GRAPHDECO, content[0][1:], strict=False))
    if isinstance(content, Mapping) and isinstance(content.get("splats", content), Mapping):
        if isinstance(content.get("pipeline"), Mapping):
            return _of_nerfstudio(content["pipeline"])
        if {"params", "strategy", "step"} <= content.keys():
            raise SceneFormatError(
                f"{path} to be {_EXPECTED}",
                found="a checkpoint of an unfinished run of splatseed",
                fix="Finish the run with `resume=True`: its folder then has the Gaussians.",
            )
        splats = content.get("splats", content)
        if "means" in splats:
            return dict(splats)
    kind = ", ".join(map(str, content)) if isinstance(content, Mapping) else type(content).__name__
    raise SceneFormatError(
        f"{path} to be {_EXPECTED}",
        found=f"other content: {kind[:200]}",
        fix="Export it as .ply with the program that trained it.",
    )


def _of_nerfstudio(pipeline: Mapping[str, Any]) -> dict[str, Any]:
    found = {}
    for key, value in pipeline.items():
        match = _NERFSTUDIO.search(key)
        if match and ("gauss_params" in key or match[1] in {*PARAMETERS, *_NERFSTUDIO_NAMES}):
            found[_NERFSTUDIO_NAMES.get(match[1], match[1])] = value
    if "sh0" in found and ("shN" not in found or not found["shN"].shape[1]):
        # Without harmonics, its colours are a sigmoid of the first parameters.
        found["sh0"] = (found["sh0"].sigmoid() - 0.5) / SH_C0
    return found
