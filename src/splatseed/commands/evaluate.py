"""``splatseed evaluate``: how close a trained model comes to photographs it has not seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from splatseed.commands.models import check_free, config_of, model_file, near_plane_of
from splatseed.commands.options import MaskChoice, parse_options, refuse
from splatseed.console import StageClock, print_note, print_pairs, print_table, stage_display
from splatseed.errors import MissingDependencyError, SceneNotFoundError
from splatseed.io.staging import check_output, output_folder, write_json
from splatseed.photos.view import View, user_cache_dir
from splatseed.requirements import require
from splatseed.text import counted
from splatseed.training.folder import RunFolder
from splatseed.training.settings import Backend, TrainSettings

if TYPE_CHECKING:  # importing PyTorch takes a while: --help must not wait for it
    from splatseed.scores import EvalResult, ViewScore

LEAST = {"data_factor": 1, "test_every": 2}
"""Numbers that a run's config gives where no option does, and their least values."""


@dataclass(frozen=True)
class Options:
    """Score a trained model on the test views of its scene: PSNR, SSIM, FLIP, LPIPS.

    PSNR is given twice: over all pixels, and over those that at least two training views see, by
    the scene's points or its own depth maps; errors elsewhere are a matter of luck. cc is
    PSNR after correcting the colours of each render, for photographs of changing exposure.
    """

    model: Annotated[Path, tyro.conf.Positional]
    """A run folder of splatseed train, or a file of Gaussians from any trainer: .ply, .spz, .sog,
    .splat."""
    scene: Path | None = None
    """The scene the model belongs to, in the same world; a run knows its own."""
    data_factor: int | None = None
    """Factor by which photographs are downsampled; by default a run's own, else 1."""
    test_every: int | None = None
    """Score every n-th image, sorted by name; by default as the run was trained, else 8."""
    transform: Annotated[str | None, tyro.conf.arg(metavar="FILE|gsplat|none")] = None
    """From the scene's world to the model's, if its trainer normalised the scene: a JSON file with
    a matrix, nerfstudio's dataparser_transforms.json, graphdeco's cameras.json, or gsplat for its
    examples' normalisation; none: score the model where it is, unchanged."""
    masks: MaskChoice = None
    """A folder of masks, where pixels of 0 do not count, or none; inverted: only they count. By
    default the run's, else the folder masks beside the photographs, and transparency."""
    lpips_weights: Path | None = None
    """The file of VGG's weights for LPIPS, or its folder; by default PyTorch's cache."""
    backend: Backend = "auto"
    """Where to render; auto takes a GPU if PyTorch sees one."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """A JSON file to write the scores to."""
    renders: Path | None = None
    """A folder for pictures: photograph, render, and FLIP of each test view."""
    overwrite: bool = False
    """Replace existing files and folders."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "evaluate", arguments)
    require("torch", "flip_evaluator")
    gaussians, config = model_file(options.model), config_of(options.model)
    scene, masks = options.scene or config.get("scene"), options.masks or config.get("masks")
    numbers: dict[str, Any] = {
        name: config.get(name, getattr(TrainSettings, name)) if given is None else given
        for name in LEAST
        for given in [getattr(options, name)]
    }
    refuse(
        (not isinstance(scene, str | Path), f"--scene, as {options.model} does not name its scene",
         "none", "Pass --scene SCENE: the scene that it was trained on."),
        *(((name, numbers[name]) != ("data_factor", None)
           and (not isinstance(numbers[name], int) or numbers[name] < least),
           f"--{name.replace('_', '-')} of {least} or more", numbers[name],
           "See splatseed evaluate --help.") for name, least in LEAST.items()),
    )  # fmt: skip
    scene = Path(str(scene))
    moved = options.scene is None and not scene.exists()
    refuse((moved, f"the scene of the run at {scene}", "none", "Say where it is: --scene SCENE."))
    if options.renders is not None:
        check_output(
            options.renders, kind="evaluate", overwrite=options.overwrite,
            protect=[scene, options.model],
        )  # fmt: skip
    if options.output is not None:
        trained = RunFolder(gaussians.parent)
        inputs = [scene, gaussians, trained.config, trained.metrics]
        check_free(options.output, overwrite=options.overwrite, protect=inputs)
    with stage_display() as clock:
        result, factor, doubts = _evaluate(options, gaussians, scene, numbers, config, masks, clock)
    rows = [
        (score.name, *_numbers(score), f"{1e3 * score.seconds:.1f}") for score in result.per_image
    ]
    print_table(
        f"{counted(len(rows), 'test view')} of {scene}",
        (
            "image",
            "PSNR, dB",
            "cc, dB",
            "co-visible, dB",
            "of pixels",
            "SSIM",
            "FLIP",
            "LPIPS",
            "render, ms",
        ),
        [*rows, ("mean", *_numbers(result), f"{1e3 * result.render_seconds:.1f}")],
    )
    facts = [
        ("Gaussians", f"{result.num_gaussians:,}"),
        ("size", f"{(result.model_bytes or 0) / 1e6:.1f} MB of parameters"),
        ("data factor", f"{factor}"),
    ]
    written = (("scores", options.output), ("renders", options.renders))
    facts += [(label, str(path)) for label, path in written if path is not None]
    print_pairs(str(options.model), facts)
    if result.lpips is None:
        print_note(f"LPIPS was not computed: {result.lpips_reason}")
    for doubt in doubts:
        print_note(doubt)


def _evaluate(
    options: Options,
    gaussians: Path,
    scene: Path,
    numbers: Mapping[str, int],
    config: Mapping[str, Any],
    masks: str | None,
    clock: StageClock,
) -> tuple[EvalResult, int, list[str]]:
    """Score the test views and write what was asked for.

    Also returns the factor that photographs were divided by, and what makes the scores doubtful.
    """
    from splatseed.splat.covisible import find_covisible, pixel_masks
    from splatseed.splat.evaluate import evaluate_model, load_model
    from splatseed.splat.metrics import load_lpips
    from splatseed.splat.rendering import picture_names, write_render
    from splatseed.training.device import pick_device

    clock("read", 0.0)
    lpips, reason = None, ""
    try:
        lpips = load_lpips(weights=options.lpips_weights)
    except (MissingDependencyError, SceneNotFoundError) as error:
        if options.lpips_weights is not None:
            raise
        reason = str(error)
    model = load_model(
        gaussians, scene, **numbers, transform=options.transform, masks=masks,
        trained_on=config.get("photographs"), near_plane=near_plane_of(config),
        device=pick_device(options.backend, clock), cache_dir=user_cache_dir(), progress=clock,
    )  # fmt: skip
    seen = pixel_masks(find_covisible(model.scene, numbers["test_every"], clock), model.views)
    asked: dict[str, Any] = {"lpips": lpips, "lpips_reason": reason, "covisible": seen}
    asked["progress"] = clock
    if options.renders is None:
        result = evaluate_model(model, **asked)
    else:
        with output_folder(options.renders, kind="evaluate", overwrite=options.overwrite) as folder:
            names = picture_names(view.name for view in model.views)

            def draw(view: View, render: Any, errors: Any) -> None:
                write_render(folder / names[view.name], view.photograph, render, errors)

            result = evaluate_model(model, on_view=draw, **asked)
    if options.output is not None:
        named = {"model": options.model, "scene": scene}
        numbers = {**numbers, "data_factor": model.data_factor}
        noted = {"notes": list(model.notes)} if model.notes else {}
        write_json(options.output, {**named, **numbers, **result.to_dict(), **noted})
    doubts, own = [*model.notes, *filter(None, [model.doubt])], config.get("test_every")
    shown = {view.name for view in model.views}
    if isinstance(own, int):
        shown &= {image.name for image in model.scene.split(own)[0]}
        told = f"{len(shown)} of these {len(model.views)} views were trained on"
        doubts += [f"{told}: the run held out one in {own}."] * bool(shown)
    return result, model.data_factor, doubts


def _numbers(scores: EvalResult | ViewScore) -> tuple[str, ...]:
    def told(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    covisible = told(scores.covisible_psnr, ".2f"), told(scores.covisible_share, ".0%")
    perceived = told(scores.flip, ".4f"), told(scores.lpips, ".4f")
    level = f"{scores.psnr:.2f}", told(scores.cc_psnr, ".2f")
    return *level, *covisible, f"{scores.ssim:.4f}", *perceived
