"""Strategy ``grow`` for other trainers: those that call the strategies of the package gsplat.

Notation: gsplat's: ``params`` holds ``means``, ``scales`` (logarithms), ``quats``, ``opacities``
(logits) and ``sh0``, ``shN``, or nerfstudio's names of these, ``features_dc``, ``features_rest``;
``viewmats`` are cam_from_world with OpenCV axes. Lengths are the trainer's, whose frame is often
the scene's rotated, moved and scaled. Promise: the class decides what grows, and where, that
``splatseed train`` runs, ``training.strategies.grow.ErrorDensification``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from splatseed.camera import Camera
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io.depth_maps import DESCRIPTION, DepthFiles, read_description
from splatseed.photos.view import NO_PIXELS, View
from splatseed.requirements import require
from splatseed.training.schedule import FULL_RUN, make_schedule
from splatseed.training.traits import GROW_EVERY, STRATEGIES

require("torch", "gsplat")  # before what imports them

import torch
from gsplat import MCMCStrategy
from torch import Tensor

from splatseed.training.device import Capacity
from splatseed.training.strategies.candidates import SH0_NAMES
from splatseed.training.strategies.grow import GROWTH, ErrorDensification

REQUIRED = ("means", "scales", "quats", "opacities")
MAKE_MAPS = "Make them with splatseed depth SCENE -o FOLDER."


@dataclass
class GrowStrategy(MCMCStrategy):  # type: ignore[misc]  # gsplat has no types
    """Spend a budget of Gaussians where renders are still wrong: ``splatseed train``'s ``grow``.

    Trainers recognise strategies by class: as a subclass of gsplat's ``MCMCStrategy``, this one is
    called in the same way, but it neither relocates Gaussians nor adds noise. In addition, call
    ``observe`` at each step. Cameras must be pinholes, photographs complete, and all Gaussians on
    one device. The defaults are for 30,000 steps: scale them with the length of the run.
    """

    absgrad: ClassVar[bool] = False  # nerfstudio 1.1.5 asks every strategy
    noise_lr: float = field(default=0.0, init=False)
    min_opacity: float = field(default=GROWTH.min_opacity, init=False)
    refine_start_iter: int = GROW_EVERY
    """First step after which Gaussians are added and removed."""
    refine_stop_iter: int = FULL_RUN // 2
    """Last step after which Gaussians are added and removed; the budget is spent at 0.7 of it."""
    refine_every: int = GROW_EVERY
    """Steps between such rounds."""
    depths: Path | None = None
    """The folder that ``splatseed depth SCENE`` wrote; without it, growth only splits."""
    depth_scale: float | None = None
    """Training units per unit of the depth maps, which are in the scene's: the scale by which the
    trainer normalises the world."""

    def check_sanity(
        self,
        params: Mapping[str, Tensor] | torch.nn.ParameterDict,
        optimizers: Mapping[str, torch.optim.Optimizer],
    ) -> None:
        """Check that growth has all parameters.

        Raises:
            ParameterError: Parameters are missing.
            AssertionError: gsplat's: an optimiser is missing, or has several groups.
        """
        missing = [name for name in REQUIRED if name not in params]
        if not any(name in params for name in SH0_NAMES):
            missing.append(" or ".join(SH0_NAMES))
        if missing:
            raise ParameterError(
                f"the parameters {', '.join(REQUIRED)} and {' or '.join(SH0_NAMES)}",
                found=f"no {', no '.join(missing)}",
                fix="Train spherical harmonics (gsplat's trainer: without app_opt).",
            )
        super().check_sanity(params, optimizers)

    def initialize_state(self) -> dict[str, Any]:
        """The state before the first step.

        Raises:
            ParameterError: ``depths`` is given without ``depth_scale``.
            SceneNotFoundError: There are no depth maps.
            SceneFormatError: They are not of planar depth.
        """
        if self.depths is None:
            return {"depths": None}
        if self.depth_scale is None:
            raise ParameterError(
                "depth_scale with depths: training units per unit of the scene",
                found="none",
                fix="Set it to the scale by which the trainer normalises the world, 1.0 if it "
                "does not.",
            )
        return {"depths": _maps_in(Path(self.depths))}

    def observe(
        self,
        params: torch.nn.ParameterDict,
        state: dict[str, Any],
        step: int,
        viewmats: Float[Tensor, "C 4 4"],
        Ks: Float[Tensor, "C 3 3"],
        renders: Float[Tensor, "C H W 3"],
        photographs: Float[Tensor, "C H W 3"],
        names: Sequence[str] | None = None,
    ) -> None:
        """Measure the result of a step; to be called at each, before ``step_post_backward``.

        Args:
            params: The parameters.
            state: The state of ``initialize_state``.
            step: The number of steps done before this one.
            viewmats: Poses of the cameras, cam_from_world in training units.
            Ks: Their intrinsics, in pixels of the photographs.
            renders: The renders.
            photographs: The photographs, 0 to 1.
            names: Of the images, as in the folder of depth maps, ``NAME.npy``; None: no depth is
                known.

        Raises:
            SceneFormatError: A depth map cannot be read, or has not its photograph's aspect ratio.
        """
        growing = self._growing(params, state)
        if not growing.should_accumulate(step):
            return
        height, width = photographs.shape[1:3]
        for i, photograph in enumerate(photographs):
            K, pose = (each[i].detach().cpu().double().numpy() for each in (Ks, viewmats))
            view = View(names[i] if names else "", NO_PIXELS, Camera(K, width, height, pose))
            growing.depths = self._depth_of(view, state, photograph.device)
            growing.observe(params, view, renders[i], photograph, step)

    def step_post_backward(
        self,
        params: torch.nn.ParameterDict,
        optimizers: dict[str, torch.optim.Optimizer],
        state: dict[str, Any],
        step: int,
        info: Any,
        lr: float | None = None,  # noqa: ARG002  (what MCMCStrategy is called with)
        packed: bool = False,  # noqa: ARG002  (what nerfstudio 1.1.5 calls every strategy with)
    ) -> None:
        """At the end of a round, prune, place and split Gaussians.

        Raises:
            ParameterError: ``observe`` was not called, or with names of which none has a depth map.
        """
        growing = self._growing(params, state)
        if not growing.should_densify(step):
            return
        if "num_initial" not in state:
            raise ParameterError(
                "a call of observe at each step, before step_post_backward",
                found=f"none up to step {step}",
                fix="Add it to the training loop.",
            )
        if state["depths"] and not state.get("matched"):
            raise ParameterError(
                f"names of images, for observe, that have depth maps in {self.depths}",
                found=f"{state.get('unmatched') or 'none'}",
                fix=f"Pass each file's path in it, without .npy: {next(iter(state['depths']))}.",
            )
        growing.after_step(params, optimizers, step, info)
        if self.verbose:
            print(f"Step {step}: {len(params['means'])} GSs.")  # noqa: T201  (as gsplat's do)

    def _growing(self, params: torch.nn.ParameterDict, state: dict[str, Any]) -> ErrorDensification:
        """Return the strategy of ``splatseed train`` at this state."""
        schedule = dataclasses.replace(
            make_schedule(STRATEGIES["grow"], 2 * self.refine_stop_iter, as_3dgs=False),
            refine_start=self.refine_start_iter,
            refine_stop=self.refine_stop_iter,
            refine_every=self.refine_every,
        )
        growing = ErrorDensification(schedule, Capacity(self.cap_max, params["means"].device))
        growing.state = state
        return growing

    def _depth_of(
        self, view: View, state: dict[str, Any], device: torch.device
    ) -> dict[str, Float[Tensor, "h w"]]:
        """Return the view's depth by its name, in training units, 0 where unknown; or nothing."""
        files: DepthFiles | None = state["depths"]
        if files is None or view.name not in files:
            state["unmatched"] = view.name
            return {}
        state["matched"] = True
        found = files.read(view.name)
        found.camera(view.camera)  # refuses another aspect ratio, such as a patch's
        assert self.depth_scale is not None  # noqa: S101  (initialize_state asks for it)
        return {
            view.name: torch.from_numpy(np.nan_to_num(found.values * self.depth_scale)).to(device)
        }


def _maps_in(folder: Path) -> DepthFiles:
    """Return the planar depth maps in a folder of ``splatseed depth``, by their images' names."""
    paths = {
        path.relative_to(folder).with_suffix("").as_posix(): path
        for path in sorted(folder.rglob("*.npy"))
    }
    if not paths:
        raise SceneNotFoundError(f"depth maps in {folder}", found="no file .npy", fix=MAKE_MAPS)
    kind, scale = read_description(folder / DESCRIPTION)
    if kind != "z":
        raise SceneFormatError(
            f"maps of planar depth (kind z) in {folder}", found=f"{kind}", fix=MAKE_MAPS
        )
    return DepthFiles(paths, kind, scale)
