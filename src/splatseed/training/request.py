"""Requests: what a caller can choose about training and about scoring, listed once.

The options of ``splatseed train`` and ``evaluate``, the keyword arguments of ``ss.train`` and
``ss.evaluate``, and the keys of ``train --config`` are the fields of these classes, with their
defaults; the fields' docstrings are the help. No PyTorch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Self

import tyro

from splatseed.errors import ParameterError
from splatseed.text import did_you_mean
from splatseed.training.settings import Backend, TrainSettings

MaskChoice = Annotated[str | None, tyro.conf.arg(metavar="DIR|none|inverted[:DIR]|alpha")]
"""The masks to use: see ``io.masks.with_masks``."""
ExcludeChoice = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    tyro.conf.arg(metavar="NAME|PATTERN|FILE", help_behavior_hint="(repeatable)"),
]
"""The photographs to leave out: see ``io.exclusion.exclude``."""
DEFAULTS = TrainSettings(strategy="auto", seeding="advised")
"""The settings of a new run of ``train``, those that score best; a resumed run has its own.

``TrainSettings()`` has strategy ``default`` (gsplat's name for 3DGS's densification) and the
scene's points: plans of ``bench`` start from it, to compare methods as in 3DGS.
"""


@dataclass(frozen=True)
class PrepareOptions:
    """What to do with a run's folder, its poses and photographs, before training."""

    refine_poses: bool = False
    """First refine a phone's or SLAM's poses, unless that gains nothing. Points are triangulated
    there in place of those with tracks; others, such as LiDAR's, stay."""
    exclude: ExcludeChoice = ()
    """Photographs to leave out: a name, a pattern such as 'IMG_00*', or a .txt file of these."""
    resume: bool = False
    """Resume the run in the output folder, with its own settings; start one if there is none."""
    tensorboard: bool = False
    """Also write a log for TensorBoard."""
    overwrite: bool = False
    """Replace an earlier run in the output folder."""


NEW_RUN = PrepareOptions()
"""Start a run in an empty folder, at the scene's poses."""


@dataclass(frozen=True)
class TrainRequest(PrepareOptions):
    """How to train, with which masks, up to how many Gaussians, and what to do with the folder."""

    settings: Annotated[TrainSettings, tyro.conf.arg(name="")] = DEFAULTS
    """The settings; their fields are options and keyword arguments of their own."""
    budget: Annotated[int | str | None, tyro.conf.arg(metavar="N|Xrho")] = None
    """Maximum Gaussians: a number, or 0.25rho for a quarter of a photograph's pixels at training
    size; by default 1rho for strategy auto and 1000000 for grow and mcmc. If there are more seeds,
    they are thinned."""
    long_side: int | None = None
    """Instead of --data-factor: downsample by area, so that the longest side of a photograph has
    this many pixels."""
    masks: MaskChoice = None
    """A folder of masks, where pixels of 0 do not count, or none; inverted: only they count. By
    default the folder masks beside the photographs. Transparent pixels are empty space around an
    object that is cut out, and do not count elsewhere; none: always empty, alpha: never."""
    named: tyro.conf.Suppress[frozenset[str]] = frozenset()
    """The settings that the caller named, which a run to resume must have, defaults or not."""

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Self:
        """Return the request of keyword arguments: fields of this class and of ``TrainSettings``.

        Raises:
            ParameterError: There is no such field, or a setting is out of range.
        """
        own = [each.name for each in fields(cls) if each.name not in {"settings", "named"}]
        known = [*own, *(each.name for each in fields(TrainSettings))]
        for name in options:
            if name not in known:
                raise ParameterError(
                    "arguments of train, or fields of TrainSettings",
                    found=name,
                    fix=f"{did_you_mean(name, known)}The fields are {', '.join(known)}.",
                )
        settings = {name: value for name, value in options.items() if name not in own}
        others = {name: value for name, value in options.items() if name in own}
        return cls(**others, settings=replace(DEFAULTS, **settings), named=frozenset(settings))


@dataclass(frozen=True)
class EvaluateRequest:
    """How to score a model."""

    data_factor: int | float | None = None
    """Factor by which photographs are downsampled; by default a run's own, else the smallest that
    leaves at most 1600 pixels on the longer side."""
    test_every: int | None = None
    """Score every n-th image, sorted by name; by default as the run was trained, else 8."""
    transform: Annotated[str | None, tyro.conf.arg(metavar="FILE|gsplat|flipped|turned|none")] = (
        None
    )
    """From the scene's world to the model's, if its trainer normalised the scene: a JSON file with
    a matrix, nerfstudio's dataparser_transforms.json, graphdeco's cameras.json, gsplat for its
    examples' normalisation, flipped for y and z negated, or turned for x and y; none: score the
    model where it is, unchanged."""
    masks: MaskChoice = None
    """A folder of masks, where pixels of 0 do not count, or none; inverted: only they count. By
    default the run's, else the folder masks beside the photographs. Transparent pixels are empty
    space around an object that is cut out, and do not count elsewhere; none: always empty, alpha:
    never."""
    exclude: ExcludeChoice = ()
    """Leave out test views, in addition to what the run left out: a name, a pattern such as
    'IMG_00*', or a .txt file with one per line."""
    background: Annotated[str | None, tyro.conf.arg(metavar="black|white|R,G,B")] = None
    """The background of renders, over which transparent pixels of photographs are composited, too;
    by default what the trainer recorded beside the model (graphdeco's cfg_args, nerfstudio's
    config.yml), else black."""
    lpips_weights: Path | None = None
    """The file of VGG's weights for LPIPS, or its folder; by default PyTorch's cache."""
    backend: Backend = "auto"
    """Where to render; auto takes a GPU if PyTorch sees one."""


AS_TRAINED = EvaluateRequest()
"""Score a run as it was trained."""
