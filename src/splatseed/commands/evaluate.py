"""``splatseed evaluate``: how close a trained model comes to photographs it has not seen."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from splatseed.commands.options import check_free, parse_options
from splatseed.console import (
    StageClock,
    add_results,
    print_note,
    print_pairs,
    print_table,
    stage_display,
)
from splatseed.findings import Finding
from splatseed.io.staging import check_output, output_folder, write_json
from splatseed.photos.view import View
from splatseed.requirements import require
from splatseed.splat.background import name_background
from splatseed.text import counted
from splatseed.training.folder import RunFolder
from splatseed.training.request import AS_TRAINED, EvaluateRequest

if TYPE_CHECKING:  # importing PyTorch takes a while: --help must not wait for it
    from splatseed.scores import EvalResult, ViewScore
    from splatseed.splat.evaluate import TrainedModel
    from splatseed.training.evaluation import Evaluation


@dataclass(frozen=True)
class Options:
    """Score a trained model on the test views of its scene: PSNR, SSIM, FLIP, LPIPS.

    PSNR is given twice: over all pixels, and over the co-visible pixels, which at least two
    training views see by the scene's points or depth maps; elsewhere errors are a matter of luck.
    cc is PSNR after correcting the colours of each render, for photographs of changing exposure.
    """

    model: Annotated[Path, tyro.conf.Positional]
    """A run folder of splatseed train, or a file of Gaussians from any trainer: .ply, .spz, .sog,
    .splat, .glb, or a checkpoint of gsplat, nerfstudio or graphdeco."""
    scene: Path | None = None
    """The scene the model belongs to, in the same world; a run knows its own."""
    request: Annotated[EvaluateRequest, tyro.conf.arg(name="")] = AS_TRAINED
    """How to score; its fields are options of their own."""
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
    from splatseed.training.evaluation import Evaluation

    evaluation = Evaluation.of(options.model, options.scene, options.request)
    scene, gaussians = Path(str(evaluation.scene)), Path(str(evaluation.model))
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
        clock("read", 0.0)
        model = evaluation.load(clock)
        result = _score(options, evaluation, model, clock)
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
        ("data factor", f"{model.data_factor:g}"),
        ("background", name_background(model.scene.background)),
    ]
    written = (("scores", options.output), ("renders", options.renders))
    facts += [(label, str(path)) for label, path in written if path is not None]
    print_pairs(str(options.model), facts)
    if result.lpips is None:
        text = f"LPIPS was not computed: {result.lpips_reason}"
        print_note(Finding("missing-lpips", text, "info"))
    print_note(*evaluation.findings(model))


def _score(
    options: Options, evaluation: Evaluation, model: TrainedModel, clock: StageClock
) -> EvalResult:
    from splatseed.splat.pictures import picture_names, write_comparison

    score = partial(evaluation.score, model, progress=clock)
    if options.renders is None:
        result = score()
    else:
        with output_folder(options.renders, kind="evaluate", overwrite=options.overwrite) as folder:
            names = picture_names(view.name for view in model.views)

            def draw(view: View, render: Any, errors: Any) -> None:
                write_comparison(folder / names[view.name], view.photograph, render, errors)

            result = score(on_view=draw)
    content: dict[str, object] = {
        "model": options.model,
        "scene": evaluation.scene,
        "data_factor": model.data_factor,
        "test_every": evaluation.test_every,
        "exclude": evaluation.request.exclude,
        "background": name_background(model.scene.background),
        **result.to_dict(),
    }
    add_results(**content)
    if options.output is not None:
        if findings := evaluation.findings(model):
            content["findings"] = [asdict(each) for each in findings]
            content["notes"] = [str(each) for each in findings]
        write_json(options.output, content)
    return result


def _numbers(scores: EvalResult | ViewScore) -> tuple[str, ...]:
    def shown(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    covisible = shown(scores.covisible_psnr, ".2f"), shown(scores.covisible_share, ".0%")
    perceived = shown(scores.flip, ".4f"), shown(scores.lpips, ".4f")
    level = f"{scores.psnr:.2f}", shown(scores.cc_psnr, ".2f")
    return *level, *covisible, f"{scores.ssim:.4f}", *perceived
