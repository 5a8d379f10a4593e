"""``splatseed export``: write trained Gaussians for viewers and engines, or as a web page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from splatseed.commands.options import check_free, parse_options, refuse
from splatseed.console import add_results, print_next, print_note, print_pairs, stage_display
from splatseed.errors import InputError, ParameterError
from splatseed.findings import Finding
from splatseed.io.exclusion import EXCLUDED
from splatseed.io.matrices import parse_similarity
from splatseed.io.origin import RECENTER, choose_origin, format_offset, offset_beside, write_offset
from splatseed.io.regions import REGION_FORM, Region, parse_region
from splatseed.photos.view import NO_PIXELS
from splatseed.progress import Note, Progress
from splatseed.requirements import require, version_of
from splatseed.scene import BLACK
from splatseed.seeding.budget import parse_budget
from splatseed.similarity import Similarity
from splatseed.splat.background import background_of, name_background
from splatseed.splat.formats import FORMATS, format_of_name, read_gaussians, write_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.model_frame import transform_gaussians, translate_gaussians
from splatseed.splat.selection import (
    filter_gaussians,
    isolated,
    kept_by_filter,
    largest,
    visible_area,
)
from splatseed.text import counted, quoted, visible
from splatseed.training.folder import RunFolder, config_of, model_file
from splatseed.training.request import ExcludeChoice
from splatseed.training.settings import TrainSettings

if TYPE_CHECKING:  # importing PyTorch takes a while: --help must not wait for it
    from splatseed.splat.render_loss import RenderLoss
    from splatseed.training.model_views import ModelViews

PAGE = ".html"
PAGE_DESCRIPTION = "html: SuperSplat's viewer with the model as .sog; browsers"
OWN = "own"
"""The value of --clean for the scene of the run."""
LOSSLESS = "ply"
NUM_CAMERAS, CAMERA_SIZE = 6, (480, 360)
"""Cameras that circle a model without a scene, and their width and height."""


@dataclass(frozen=True)
class Options:
    """Write a trained model in another format or as a web page; crop, thin, clean or move it."""

    model: Annotated[Path, tyro.conf.Positional]
    """A run folder of splatseed train, or a file of Gaussians: .ply, .compressed.ply, .splat, .spz,
    .sog, .glb, or a checkpoint of gsplat, nerfstudio or graphdeco."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The file to write; its suffix chooses the format: .ply, .splat, .spz, .sog, or .html, a page
    with viewer and model that browsers open from disk."""
    scene: Path | None = None
    """The scene of a file of Gaussians, for --budget and the score that the format costs; a run has
    its own."""
    exclude: ExcludeChoice = ()
    """Photographs of the scene to leave out: a name, a pattern such as 'IMG_00*', or a .txt file of
    these."""
    crop: Annotated[str | None, tyro.conf.arg(metavar=REGION_FORM)] = None
    """Keep the Gaussians whose centres lie in this box, sphere (centre, radius), or turned box (a
    file or 16 numbers: the matrix from a cube of side 1 around 0), in the model's coordinates;
    write --crop=-1,... if the first number is negative."""
    min_opacity: float = 0.0
    """Remove Gaussians of a lower opacity, 0 to 1."""
    clean: Annotated[str | None, tyro.conf.arg(metavar="SCENE|own")] = None
    """Remove floaters, Gaussians where the photographs of this scene show free space; own: the
    scene of the run."""
    drop_isolated: bool = False
    """Remove Gaussians far from all others for their size: floaters, without photographs."""
    budget: Annotated[str | None, tyro.conf.arg(metavar="N")] = None
    """Keep at most this many Gaussians, such as 50k: those that change the renders of the training
    views most; without a scene, those of the largest opacity times area."""
    transform: Annotated[str | None, tyro.conf.arg(metavar="FILE|16 numbers")] = None
    """Move the model by a matrix from old to new coordinates, row by row: a rotation, one scale and
    a translation. Sizes and view-dependent colours follow."""
    overwrite: bool = False
    """Replace an existing file."""


@dataclass(frozen=True)
class _Job:
    """What is exported, checked before any work."""

    options: Options
    path: Path  # of the model's Gaussians
    format: str  # a name of FORMATS, or PAGE
    config: Mapping[str, Any]  # of the run; empty for other models
    scene: Path | None  # of the model, if it is known and there
    crop: Region | None
    transform: Similarity | None
    budget: int | None

    @property
    def is_page(self) -> bool:
        """Whether a web page is written."""
        return self.format == PAGE


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    job = _checked(parse_options(Options, "export", arguments))
    target, findings = job.options.output, list[Finding]()
    with stage_display() as clock:
        clock("read", 0.0)
        gaussians = read_gaussians(job.path, findings.append)
        cropped = filter_gaussians(gaussians, job.crop)
        views = _views(job, gaussians, clock, findings.append)
        kept, rows = _kept(job, gaussians, views, clock)
        stages = {"model": cropped}
        if len(kept) < len(cropped):
            stages["kept"] = kept
        if job.is_page:
            stages["page"] = _write_page(job, kept, views, clock, findings.append)
        else:
            placed = _write_file(job, kept, clock, findings.append)
            if job.format != LOSSLESS:
                stages["file"] = transform_gaussians(read_gaussians(target), placed.inverse)
        loss = _loss(stages, views, cropped=job.crop is not None, progress=clock)
    before, after = job.path.stat().st_size, target.stat().st_size
    described = PAGE_DESCRIPTION if job.is_page else FORMATS[job.format].description
    rows = [
        ("Gaussians", f"{len(kept):,} of {len(gaussians):,}"),
        *rows,
        *_loss_rows(loss, stages, views),
        ("format", described if job.is_page else f"{job.format}: {described}"),
        ("size", f"{after / 1e6:.2f} MB, of {before / 1e6:.2f} MB read"),
        ("output", str(target)),
    ]
    print_pairs("splatseed export", rows)
    add_results(
        output=target, format=job.format, gaussians=len(kept), of=len(gaussians), bytes=after
    )
    if loss is not None:
        alike = dict(zip(list(stages)[1:], loss.likeness, strict=True))
        psnr = dict(zip(stages, loss.scores, strict=bool(loss.scores)))
        add_results(views=loss.views, psnr=psnr, likeness=alike)
    print_note(*findings, *_format_findings(job), *_loss_findings(loss, stages, job))
    _print_next(job)


def _checked(options: Options) -> _Job:
    """Refuse what cannot be exported, before any work."""
    target, path = options.output, model_file(options.model)
    page = target.name.lower().endswith(PAGE)
    name = PAGE if page else format_of_name(target, (PAGE,))
    crop = None if options.crop is None else parse_region(options.crop, "crop")
    transform = None if options.transform is None else parse_similarity(options.transform)
    cleans = options.clean is not None
    config = config_of(options.model)
    wanted: Any = options.clean if cleans and options.clean != OWN else options.scene
    wanted = wanted or config.get("scene")
    scene = Path(wanted) if isinstance(wanted, str | Path) else None
    gone = options.clean == OWN and scene is not None and not scene.exists()
    refuse((gone, f"the scene of the run at {scene}", "none", "Say where it is: --clean SCENE."))
    named = cleans or options.scene is not None
    check_free(target, overwrite=options.overwrite, protect=[scene] if scene and named else [])
    refuse(
        (options.clean == OWN and scene is None,
         f"--clean SCENE, as {options.model} does not name its scene", OWN,
         "Name the scene that it was trained on."),
        (target.exists() and target.samefile(path), f"another file than {target}", "the model's",
         "Choose another name."),
        (RunFolder(target.resolve().parent).is_run, f"a file outside training runs, not {target}",
         "the folder of a run", "Choose a place beside the run."),
        (options.scene is not None and not options.scene.exists(), f"a scene at {options.scene}",
         "none", "Check the path."),
        (page and transform is not None, "--transform for a file of Gaussians", "a web page",
         "A page shows the model in its scene's frame: leave it out."),
    )  # fmt: skip
    compared = cleans or options.budget is not None or name != LOSSLESS
    refuse(
        (options.exclude and (scene is None or not compared),
         "--exclude where photographs of a scene are compared", "a model alone",
         f"Leave it out; --clean, --budget and formats other than .{LOSSLESS} compare them."),
    )  # fmt: skip
    if cleans or page:  # a page's harmonics are turned
        require("torch")
    if named and options.budget is not None:
        require("torch", "gsplat")
    budget = None if options.budget is None else parse_budget(options.budget, 0)
    if not named and scene is not None and not scene.exists():
        scene = None  # the run was made elsewhere
    return _Job(options, path, name, config, scene, crop, transform, budget)


def _split(job: _Job) -> dict[str, Any]:
    """Return the options of the run that choose the views and their size, as far as known."""
    options = {name: job.config.get(name) for name in ("data_factor", "test_every")}
    return {name: value for name, value in options.items() if isinstance(value, int | float)}


def _views(job: _Job, gaussians: Gaussians, progress: Progress, note: Note) -> ModelViews | None:
    """Find the views of the model's scene, if they are needed and there.

    Those of a scene that the user names are an error if they cannot be used.
    """
    needed = job.budget is not None or job.format != LOSSLESS
    if job.scene is None or not needed:
        return None
    named = job.options.scene is not None
    if not named and not job.is_page and not _renders():
        return None
    if not job.is_page:
        require("torch", "gsplat")
    from splatseed.training.model_views import find_model_views

    try:
        views = find_model_views(
            job.path, gaussians, job.scene, job.config, progress, job.options.exclude
        )
    except InputError as error:
        if named:
            raise
        text = f"The model is not compared with the photographs of {job.scene}: {error}"
        note(Finding("scene-not-used", text, "info"))
        return None
    for each in views.scene.findings:
        if each.kind == EXCLUDED:
            note(each)
    return views


def _kept(
    job: _Job, gaussians: Gaussians, views: ModelViews | None, progress: Progress
) -> tuple[Gaussians, list[tuple[str, str]]]:
    """Choose the Gaussians to write; also return rows on what was left out."""
    options, rows = job.options, list[tuple[str, str]]()
    # What leaves nothing is refused before photographs are compared.
    keep = kept_by_filter(gaussians, job.crop, options.min_opacity)
    if options.clean is not None:
        from splatseed.training.floaters import floaters_of_model

        masks = job.config.get("masks")
        bad = floaters_of_model(
            job.path, Path(str(job.scene)), masks=masks, excluded=options.exclude,
            progress=progress, **_split(job),
        )  # fmt: skip
        rows.append(("floaters", f"{np.count_nonzero(bad):,} left out"))
        keep &= ~bad
    if options.drop_isolated:
        bad = isolated(gaussians)
        rows.append(("isolated", f"{np.count_nonzero(bad & keep):,} left out"))
        keep &= ~bad
    if not keep.any():
        raise ParameterError(
            "Gaussians that are left", found=f"none of {len(gaussians):,}",
            fix="Leave one of `crop`, `min_opacity`, `clean` and `drop_isolated` out.",
        )  # fmt: skip
    kept = gaussians if keep.all() else gaussians.select(keep)
    if job.budget is not None and job.budget < len(kept):
        kept, how = _within_budget(job.budget, kept, views, progress)
        rows.append(("budget", f"{job.budget:,}, {how}"))
    return kept, rows


def _within_budget(
    budget: int, gaussians: Gaussians, views: ModelViews | None, progress: Progress
) -> tuple[Gaussians, str]:
    """Thin Gaussians to a budget; also return how, in words."""
    if views is None:
        kept = gaussians.select(largest(visible_area(gaussians), budget))
        return kept, "by opacity and area; name the --scene for a better choice"
    from splatseed.training.decimation import fit_sizes, most_needed
    from splatseed.training.floaters import render_device

    device = render_device(progress)
    kept = gaussians.select(most_needed(gaussians, views, budget, device, progress))
    kept, share = fit_sizes(kept, gaussians, views, device, progress)
    how = f"by what changes in {counted(len(views.train), 'training view')}"
    return kept, how + (f"; sizes + {share:.0%}" if share else "")


def _write_file(job: _Job, kept: Gaussians, progress: Progress, note: Note) -> Similarity:
    """Write the Gaussians, and the file with their offset; return how they were moved."""
    path, target = job.path, job.options.output
    moved, offset = Similarity(1.0, np.eye(3), np.zeros(3)), offset_beside(path)
    if job.transform is not None:
        moved, offset = job.transform, None  # into a frame of the user's
        kept = transform_gaussians(kept, moved)
    far = choose_origin(kept.means)
    if far.any():
        kept = translate_gaussians(kept, -far)
        moved = moved.then(Similarity(1.0, np.eye(3), -far))
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
    return moved


def _write_page(
    job: _Job, kept: Gaussians, views: ModelViews | None, progress: Progress, note: Note
) -> Gaussians:
    """Write the Gaussians as a web page, named after the run or the file; return what it shows."""
    from splatseed.viewer.models import ViewerItem
    from splatseed.viewer.web_page import write_page

    model, world = job.options.model, None if views is None else views.file_from_scene
    name = model.resolve().name if model.is_dir() else model.stem
    placed = kept if world is None else transform_gaussians(kept, world.inverse)
    if views is None:
        item = ViewerItem(name, None, placed, background=background_of(job.path) or BLACK)
    else:
        scene = views.scene
        item = ViewerItem(name, scene, placed, **_split(job), background=scene.background)
    shown = write_page(job.options.output, item, progress, note)
    return shown if world is None else transform_gaussians(shown, world)


def _renders() -> bool:
    """Whether the packages that render are there."""
    return all(map(version_of, ("torch", "gsplat")))


def _loss(
    stages: Mapping[str, Gaussians], views: ModelViews | None, *, cropped: bool, progress: Progress
) -> RenderLoss | None:
    """Compare renders of the stages of a model; None for a single one, or where none are made.

    A model without a scene is rendered from cameras around it. Photographs show more than a crop.
    """
    if len(stages) < 2 or not _renders():
        return None
    from splatseed.splat.render_loss import measure_loss
    from splatseed.splat.training_frame import NO_POINTS, frame_of_model
    from splatseed.training.floaters import render_device

    models, device = list(stages.values()), render_device(progress)
    if views is None:
        from splatseed.viewer.flights import orbit

        around = orbit([], models[0], NUM_CAMERAS, CAMERA_SIZE)
        frame = frame_of_model(around, NO_POINTS, models[0])
        return measure_loss(models, around, frame, device, progress)
    test = [replace(view, photograph=NO_PIXELS) if cropped else view for view in views.test]
    background = views.scene.background
    return measure_loss(models, test, views.frame, device, progress, background, views.label)


def _loss_rows(
    loss: RenderLoss | None, stages: Mapping[str, Gaussians], views: ModelViews | None
) -> list[tuple[str, str]]:
    """Return the row with the score of each stage, or with how alike they look."""
    if loss is None:
        return []
    if loss.scores:
        scores = ", ".join(f"{n} {x:.2f} dB" for n, x in zip(stages, loss.scores, strict=True))
        return [("score", f"{scores}; PSNR, {counted(loss.views, loss.label)}")]
    where = "around it" if views is None else "of its scene"
    alike = ", ".join(
        f"{name} {x:.1f} dB"
        if np.isfinite(x)
        else f"{name} {'not seen' if np.isnan(x) else 'equal'}"
        for name, x in zip(list(stages)[1:], loss.likeness, strict=True)
    )
    return [("likeness", f"{alike}; PSNR of renders, {counted(loss.views, 'camera')} {where}")]


def _loss_findings(
    loss: RenderLoss | None, stages: Mapping[str, Gaussians], job: _Job
) -> list[Finding]:
    packed = {"file", "page"} & stages.keys()
    found = loss.finding(job.options.output.suffix) if loss and packed else None
    return [found] if found else []


def _format_findings(job: _Job) -> list[Finding]:
    """Return what is to be known of the format of the file read."""
    findings = []
    if job.path.suffix.lower() == ".spz" != job.options.output.suffix.lower():
        text = "The axes of the .spz were read as right, up, back, as specified."
        fix = "If the result is upside down, they had not been converted (docs/models.md)."
        findings.append(Finding("spz-axes", text, "info", fix=fix))
    return findings


def _print_next(job: _Job) -> None:
    options = job.options
    if job.is_page:
        link = visible(options.output.resolve().as_uri())
        own = {each.name for each in fields(options)} - {"model", "output", "overwrite"}
        same = any(getattr(options, name) != getattr(Options, name) for name in own)
        label = f"for SuperSplat's editor{', with the same options' * same}"
        sog = quoted(options.output.with_suffix(".sog"))
        packed = f"splatseed export {quoted(options.model)} -o {sog}"
        opened = "open it in a browser, here or wherever you send it"
        print_next([(opened, link), (label, packed)])
        return
    rows = [("look at it", f"splatseed view {quoted(options.output)}")]
    split = job.config.get("split")
    unscored = isinstance(split, dict) and not split.get("test")  # nothing was held out
    if job.transform is None and not unscored:  # moved, its scene is elsewhere
        rows.append(("score it", _scoring_command(job)))
    print_next(rows)


def _scoring_command(job: _Job) -> str:
    """Return the command that scores the file as its run was; unknown values are placeholders."""
    options, config = job.options, job.config
    scene, factor, every = (config.get(name) for name in ("scene", "data_factor", "test_every"))
    scene = str(job.scene) if job.scene is not None else scene
    words = ["splatseed evaluate", quoted(options.output)]
    words += ["--scene", quoted(scene) if isinstance(scene, str) else "SCENE"]
    if not isinstance(factor, int | float):
        text = "Score it at the size of training: N is the --data-factor of the run."
        print_note(Finding("unknown-data-factor", text, "info"))
        words += ["--data-factor", "N"]
    elif factor != 1:
        words += ["--data-factor", str(factor)]
    if isinstance(every, int) and every != TrainSettings.test_every:
        words += ["--test-every", str(every)]
    own = options.clean in {None, OWN} and options.scene is None
    if config.get("masks") is not None and own:
        words += ["--masks", quoted(config["masks"])]
    words += [f"--exclude {quoted(each)}" for each in options.exclude]
    background = None if config else background_of(job.path)
    if background is not None and background != BLACK:
        words += ["--background", name_background(background)]
    return " ".join(words)
