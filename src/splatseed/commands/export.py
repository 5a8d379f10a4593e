"""``splatseed export``: write trained Gaussians for viewers and engines, or as a web page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from splatseed.commands.options import check_free, parse_options, refuse
from splatseed.console import print_note, print_pairs, stage_display
from splatseed.findings import Finding
from splatseed.io.origin import RECENTER, choose_origin, format_offset, offset_beside, write_offset
from splatseed.progress import Note, Progress
from splatseed.requirements import require
from splatseed.scene import BLACK
from splatseed.splat.background import background_of, name_background
from splatseed.splat.formats import (
    FORMATS,
    filter_gaussians,
    format_of_name,
    parse_crop,
    read_gaussians,
    write_gaussians,
)
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.model_frame import translate_gaussians
from splatseed.text import quoted, visible
from splatseed.training.folder import RunFolder, config_of, model_file
from splatseed.training.settings import TrainSettings

PAGE = ".html"
PAGE_DESCRIPTION = "html: one colour per Gaussian, their mean over the training cameras; browsers"
OWN = "own"
"""The value of --clean for the scene of the run."""


@dataclass(frozen=True)
class Options:
    """Write a trained model in another format or as a web page, optionally cropped and cleaned."""

    model: Annotated[Path, tyro.conf.Positional]
    """A run folder of splatseed train, or a file of Gaussians: .ply, .compressed.ply, .splat, .spz,
    .sog, .glb, or a checkpoint of gsplat, nerfstudio or graphdeco."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The file to write; its suffix chooses the format: .ply, .splat, .spz, .sog, or .html, a page
    with viewer and model that browsers open from disk."""
    crop: Annotated[str | None, tyro.conf.arg(metavar="x0,y0,z0,x1,y1,z1")] = None
    """Keep the Gaussians whose centres lie in this box, in world coordinates; write --crop=-1,...
    if the first number is negative."""
    min_opacity: float = 0.0
    """Remove Gaussians of a lower opacity, 0 to 1."""
    clean: Annotated[str | None, tyro.conf.arg(metavar="SCENE|own")] = None
    """Remove floaters, Gaussians where the photographs of this scene show free space; own: the
    scene of the run."""
    overwrite: bool = False
    """Replace an existing file."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "export", arguments)
    page = options.output.name.lower().endswith(PAGE)
    name = PAGE if page else format_of_name(options.output, (PAGE,))
    crop = None if options.crop is None else parse_crop(options.crop)
    path, target = model_file(options.model), options.output
    cleans = options.clean is not None
    config = config_of(options.model) if cleans else {}
    scene = config.get("scene") if options.clean == OWN else options.clean
    inputs = [Path(scene)] if isinstance(scene, str) else []
    moved = options.clean == OWN and isinstance(scene, str) and not Path(scene).exists()
    refuse((moved, f"the scene of the run at {scene}", "none", "Say where it is: --clean SCENE."))
    check_free(target, overwrite=options.overwrite, protect=inputs)
    refuse(
        (options.clean == OWN and not isinstance(scene, str),
         f"--clean SCENE, as {options.model} does not name its scene", OWN,
         "Name the scene that it was trained on."),
        (target.exists() and target.samefile(path), f"another file than {target}", "the model's",
         "Choose another name."),
        (RunFolder(target.resolve().parent).is_run, f"a file outside training runs, not {target}",
         "the folder of a run", "Choose a place beside the run."),
    )  # fmt: skip
    if cleans or page:
        require("torch", *["viser"] * page)
    findings: list[Finding] = []
    with stage_display() as clock:
        clock("read", 0.0)
        gaussians = read_gaussians(path, findings.append)
        # What leaves nothing is refused before photographs are compared.
        kept = filter_gaussians(gaussians, crop, options.min_opacity)
        floaters = np.zeros(len(gaussians), bool)
        if cleans:
            from splatseed.training.floaters import floaters_of_model

            names = ("data_factor", "test_every")
            numbers = {n: value for n in names if isinstance(value := config.get(n), int)}
            masks = config.get("masks")
            floaters = floaters_of_model(
                path, Path(str(scene)), masks=masks, progress=clock, **numbers
            )
            kept = filter_gaussians(gaussians.select(~floaters), crop, options.min_opacity)
        if page:
            _write_page(options.model, path, kept, target, clock, findings.append)
        else:
            _write_file(path, kept, target, clock, findings.append)
    before, after = path.stat().st_size, target.stat().st_size
    rows = [
        ("Gaussians", f"{len(kept):,} of {len(gaussians):,}"),
        *[("floaters", f"{np.count_nonzero(floaters):,} left out")] * cleans,
        ("format", PAGE_DESCRIPTION if page else f"{name}: {FORMATS[name].description}"),
        ("size", f"{after / 1e6:.2f} MB, of {before / 1e6:.2f} MB read"),
        ("output", str(target)),
    ]
    print_pairs("splatseed export", rows)
    if path.suffix.lower() == ".spz" != target.suffix.lower():
        text = "The axes of the .spz were read as right, up, back, as specified."
        fix = "If the result is upside down, they had not been converted (docs/models.md)."
        findings.append(Finding("spz-axes", text, "info", fix=fix))
    print_note(*findings)
    if page:
        link = visible(target.resolve().as_uri())
        print_pairs("next", [("open it in a browser, here or wherever you send it", link)])
    else:
        looking = ("look at it", f"splatseed view {quoted(options.output)}")
        print_pairs("next", [looking, ("score it", _scoring_command(options))])


def _write_file(path: Path, kept: Gaussians, target: Path, progress: Progress, note: Note) -> None:
    offset, far = offset_beside(path), choose_origin(kept.means)
    kept = translate_gaussians(kept, -far) if far.any() else kept
    offset = far if offset is None else offset + far
    write_gaussians(target, kept, progress, note)
    write_offset(target, offset)
    if offset.any():
        note(
            Finding(
                "far-from-origin",
                f"The file is around {format_offset(offset)}, as {target.name}.{RECENTER} beside "
                "it records: coordinates before = after + offset.",
                "info",
            )
        )


def _write_page(
    model: Path, path: Path, kept: Gaussians, target: Path, progress: Progress, note: Note
) -> None:
    """Write the Gaussians as a web page, named after the run or the file."""
    from splatseed.viewer.models import item_of_model
    from splatseed.viewer.web_page import check_page_size, write_page

    check_page_size(len(kept))
    name = model.resolve().name if model.is_dir() else model.stem
    item = item_of_model(name, path, kept, note)
    write_page(target, item, progress, note)


def _scoring_command(options: Options) -> str:
    """Return the command that scores the file as its run was; unknown values are placeholders."""
    config = config_of(options.model)
    scene, factor, every = (config.get(name) for name in ("scene", "data_factor", "test_every"))
    scene = scene if options.clean in {None, OWN} else options.clean
    words = ["splatseed evaluate", quoted(options.output)]
    words += ["--scene", quoted(scene) if isinstance(scene, str) else "SCENE"]
    if not isinstance(factor, int):
        text = "Score it at the size of training: N is the --data-factor of the run."
        print_note(Finding("unknown-data-factor", text, "info"))
        words += ["--data-factor", "N"]
    elif factor != 1:
        words += ["--data-factor", str(factor)]
    if isinstance(every, int) and every != TrainSettings.test_every:
        words += ["--test-every", str(every)]
    if config.get("masks") is not None and options.clean in {None, OWN}:
        words += ["--masks", quoted(config["masks"])]
    background = None if config else background_of(model_file(options.model))
    if background is not None and background != BLACK:
        words += ["--background", name_background(background)]
    return " ".join(words)
