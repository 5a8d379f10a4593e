"""Suggest the next commands; each works on the scene for which it is printed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from shutil import which
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from splatseed.console import print_next, print_note
from splatseed.depth.settings import PER_POINT
from splatseed.findings import Finding
from splatseed.io.downsampling import reduced_size
from splatseed.io.staging import read_manifest
from splatseed.io.transforms_layout import Layout
from splatseed.lens import undistorted_folder
from splatseed.photos.sizes import default_factor, factor_for_side, factor_for_size
from splatseed.progress import available_cpus
from splatseed.scene import Image, Scene
from splatseed.seeding.advice import AS_IT_IS, SEEDED, Advice, is_distorted, untrainable
from splatseed.seeding.photo_methods import Auto
from splatseed.text import format_duration, quoted
from splatseed.training.duration import planned_seconds
from splatseed.training.request import DEFAULTS
from splatseed.training.schedule import FULL_RUN, default_steps
from splatseed.training.settings import BUDGET, TrainSettings
from splatseed.training.traits import StrategyTraits

TrainerName: TypeAlias = Literal[
    "splatseed", "gsplat", "graphdeco", "nerfstudio", "brush", "opensplat", "lichtfeld", "spirula"
]
RATIO = 16
SMALL_SIDE, SMALL_STEPS = 480, 1500
"""A run of minutes on a CPU: 146 photographs take 132 seconds on one core (README)."""
SEED_SECONDS, REFINE_SECONDS = 0.5, 1.5
"""CPU seconds per photograph for seeds and refined poses (benchmarks/README.md, real size)."""
COLMAP_ONLY = frozenset({"gsplat", "graphdeco", "LichtFeld"})
"""Trainers that read COLMAP's layout better than transforms.json."""
COMMON_LENSES = frozenset({"SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"})
"""Camera models with distortion that trainers handle (docs/trainers.md), if not in ``LENSES``."""
LENSES = {
    "splatseed": frozenset[str](),
    "graphdeco": frozenset[str](),
    "OpenSplat": frozenset({"SIMPLE_RADIAL", "OPENCV"}),
}
CENTRED = 0.5
"""Offset of a principal point from the centre, in pixels, above which a note warns."""

Commands = list[tuple[str, str]]


class Source(NamedTuple):
    """A scene that commands read, and the photographs that they leave out."""

    path: Path
    excluded: Sequence[str] = ()  # as given to --exclude

    def __str__(self) -> str:
        """Return the words of a command line."""
        return " ".join([quoted(self.path), *(f"--exclude {quoted(p)}" for p in self.excluded)])

    @property
    def undistortion(self) -> str:
        """The command that undistorts it, as ``undistort_command``."""
        return f"splatseed undistort {self} -o {quoted(undistorted_folder(self.path))}"


class Planned(NamedTuple):
    """How a scene will be trained, and the options of train for it."""

    budget: int
    rho: str  # the budget per pixel, and the photograph's size; empty without photographs
    max_steps: int
    strategy: StrategyTraits
    max_seeds: int
    flags: str
    trainer: TrainerName
    seconds: float  # roughly, of all steps of splatseed's own training on this machine's CPU
    most_seeds: int  # that auto makes without a budget

    @classmethod
    def of(
        cls,
        scene: Scene,
        budget: str | None = None,
        max_steps: int | None = None,
        trainer: TrainerName = "splatseed",
        long_side: int | None = None,
    ) -> Planned:
        """Plan the training of a scene by the options of ``info``.

        The other trainers densify as 3DGS does by default.
        """
        images = scene.images
        factor: float = default_factor(images)
        if images and long_side is not None:
            factor = factor_for_side(images, long_side)
        lenses = [image.lens for image in images]
        sizes = [reduced_size(lens.width, lens.height, factor) for lens in lenses]
        pixels = round(float(np.median([w * h for w, h in sizes]))) if sizes else BUDGET
        number, flags = max(2, min(BUDGET, pixels)), ""
        if budget is not None:
            from splatseed.seeding.budget import points_within

            number = max(2, points_within(scene, budget))
            flags = f"--budget {number} "
        if max_steps is not None:
            flags = f"{flags}--max-steps {max_steps} "
        elif trainer == "splatseed":
            max_steps = default_steps(len(scene.split(scene.default_test_every)[0]))
        else:
            max_steps = FULL_RUN
        strategy = DEFAULTS.strategy if trainer == "splatseed" else "default"
        settings = TrainSettings(strategy=strategy, max_steps=max_steps, cap_max=number)
        max_seeds = settings.max_seeds(number)
        rho = ""
        if sizes:
            width, height = sorted(sizes, key=math.prod)[len(sizes) // 2]
            rho = f"{number / pixels:.2g}rho of {width} x {height} pixels"
        seeds = min(len(scene.points), max_seeds) or max_seeds
        seconds = planned_seconds(settings, seeds, pixels, available_cpus())
        most = len(scene.points) + _most_seeds(images)
        traits = settings.traits
        return cls(number, rho, max_steps, traits, max_seeds, flags, trainer, seconds, most)

    @property
    def facts(self) -> dict[str, object]:
        """What ``--json`` prints."""
        plan = {"budget": self.budget, "max_steps": self.max_steps, "max_seeds": self.max_seeds}
        return {**plan, "strategy": self.strategy.name, "trainer": self.trainer}


def advice_commands(
    source: Source, scene: Scene, advice: Advice, planned: Planned, *, refine: bool
) -> Commands:
    """Return the commands that follow the advice; with ``refine``, poses are refined first.

    Of a scene without points, splatseed trains from seeds of the training photographs alone, so
    that the score of the others is honest; seeds of all are for other trainers.
    """
    if untrainable(scene):
        if advice.method in {AS_IT_IS, SEEDED}:
            return [("look", f"splatseed view {source}")]
        return [("seeds", _seeding(source, advice, planned, refine=refine))]
    first: Commands = []
    own = planned.trainer == "splatseed"
    handled = {name.lower(): lenses for name, lenses in LENSES.items()}
    lenses = distorted_lenses(scene)
    if not lenses <= handled.get(planned.trainer, COMMON_LENSES):
        first = [("undistort", source.undistortion)]
        source = Source(undistorted_folder(source.path))
        lenses = frozenset()
    plan = f"--budget {planned.budget} --max-steps {planned.max_steps}"
    refining = "--refine-poses " if refine else ""
    if not own:
        return [*first, *_for_trainer(source, scene, advice, planned, lenses, refine=refine)]
    if advice.method == SEEDED:
        how = planned.flags
    elif advice.method == AS_IT_IS:
        how = f"--seeds scene {plan} "
    elif advice.method == "auto":
        how = f"{refining}{plan} "
    else:
        seeds = ("seeds", _seeding(source, advice, planned, refine=refine))
        return [*first, seeds, ("train", f"splatseed train OUT {plan} -o RUN")]
    train, label = f"splatseed train {source} {how}-o RUN", "train"
    shorter: Commands = []
    if not (which("nvidia-smi") or which("rocminfo")):
        made = advice.method == "auto"
        first_seconds = _seconds_before(scene, seeds=made, refine=refine and made)
        label = f"train, about {format_duration(planned.seconds + first_seconds)}"
        shorter = _shorter(source, scene, planned, seeds=made, refine=refine)
    commands = [*first, (label, train), *shorter]
    if advice.method == "auto":
        others = _seeding(source, advice, planned, refine=refine)
        return [*commands, ("seeds for another trainer", others)]
    return [*commands, ("another trainer", f"splatseed info {source} --for gsplat")]


def _shorter(
    source: Source, scene: Scene, planned: Planned, *, seeds: bool, refine: bool
) -> Commands:
    """Return the command for a run of minutes, if it is shorter than the planned one."""
    small = Planned.of(scene, None, SMALL_STEPS, long_side=SMALL_SIDE)
    if small.seconds >= planned.seconds:
        return []
    seconds = small.seconds + _seconds_before(scene, seeds=seeds, refine=refine)
    size = f"--long-side {SMALL_SIDE} " if factor_for_side(scene.images, SMALL_SIDE) > 1 else ""
    how = f"{'--refine-poses ' * refine}{size}--max-steps {SMALL_STEPS} -o SMALL"
    return [(f"or about {format_duration(seconds)}", f"splatseed train {source} {how}")]


def _seeding(source: Source, advice: Advice, planned: Planned, *, refine: bool) -> str:
    how = f"--method {advice.method} --ratio 4"
    if advice.method == "auto":  # as train seeds: more gain nothing in a whole run
        fits = planned.most_seeds <= planned.max_seeds
        how = "" if fits else f"--budget {planned.max_seeds} --auto.no-dense"
    elif advice.method in {AS_IT_IS, SEEDED}:
        how = "--method linear --ratio 1"
    options = [how, "--refine-poses" if refine else "", "-o OUT"]
    return " ".join([f"splatseed upsample {source}", *filter(None, options)])


def _seconds_before(scene: Scene, *, seeds: bool, refine: bool) -> float:
    """Estimate the seconds that ``train`` takes on this machine's CPU before its first step."""
    each = SEED_SECONDS * seeds + REFINE_SECONDS * refine
    return each * len(scene.images) / available_cpus()


def _most_seeds(images: Sequence[Image]) -> int:
    """Return how many seeds ``auto`` makes at most: one per ``spacing`` of each photograph."""
    settings = Auto()
    if not images:
        return 0
    factor = factor_for_size(images, settings.max_size)
    step = factor * settings.spacing
    sizes = [(image.camera.width, image.camera.height) for image in images]
    return sum(math.ceil(width / step) * math.ceil(height / step) for width, height in sizes)


def _for_trainer(
    source: Source,
    scene: Scene,
    advice: Advice,
    planned: Planned,
    lenses: frozenset[str],
    *,
    refine: bool,
) -> Commands:
    read = scene.source.format
    layout: Layout = "transforms" if read == "transforms" else "colmap"
    if read_manifest(scene.source.root).get("format") == "both":
        layout = "both"
    other = read not in {"colmap", "transforms"} or (
        layout == "transforms" and planned.trainer in map(str.lower, COLMAP_ONLY)
    )
    commands, path = Commands(), source.path
    if other or source.excluded or advice.method not in {AS_IT_IS, SEEDED}:
        seeds = _seeding(source, advice, planned, refine=refine)
        if other:
            layout, seeds = "colmap", f"{seeds} --format colmap"
        commands, path = [("seeds", seeds)], Path("OUT")
    named = {name.lower(): command for name, command in training_commands(path, layout, lenses)}
    return [*commands, ("train", named[planned.trainer])]


def after_depth(source: Source, scene: Scene, maps: Path, known: int, *, aligned: bool) -> Commands:
    """Return the commands that use the depth maps made for a scene.

    ``known`` of their pixels have a depth; ``aligned``: they are in the scene's unit, as stereo's
    are and a network's are not.
    """
    looking = show_maps(source, maps)
    number = number_option(len(scene.points), known, Planned.of(scene).max_seeds)
    if is_distorted(scene):  # seeds are lifted along the rays of a pinhole camera
        begin = ("for seeds, begin with", source.undistortion)
        return [looking] if aligned else [looking, begin]
    if len(scene.points) or aligned:
        how = number if len(scene.points) else f"--depth.no-align {number}"
        return [looking, ("use", lifting_command(source, maps, how))]
    points = ("points to align to", triangulate_command(source, scene, "SCENE"))
    use = lifting_command(Source(Path("SCENE")), maps, f"--ratio {RATIO}")
    return [looking, points, ("use", use)]


def show_maps(source: Source, maps: Path) -> tuple[str, str]:
    """Return the command that shows depth maps."""
    picture = quoted(f"{maps.resolve().name}.png")
    return "look", f"splatseed info {source} --depth {quoted(maps)} --picture {picture}"


def number_option(points: int, known: int, limit: int) -> str:
    """Return the option for as many points as ``known`` pixels of depth give, up to ``limit``.

    Of a scene with points, at most ``RATIO`` times as many.
    """
    number = max(points + 1, min(limit, points + known // PER_POINT))
    return f"--ratio {RATIO}" if 0 < RATIO * points <= number else f"--num-points {number}"


def lifting_command(source: Source, maps: Path, how: str) -> str:
    """Return the command that makes seeds from depth maps."""
    seeds = f"splatseed upsample {source} --method depth --depth {quoted(maps)}"
    return f"{seeds} {how} -o OUT"


def triangulate_command(source: Source, scene: Scene, output: str) -> str:
    """Return the command that triangulates points for a scene's poses."""
    photographs = scene.source.image_dir
    images = "IMAGES" if photographs is None else quoted(photographs)
    return f"splatseed sfm {images} --poses-from {source} -o {output}"


def print_training(source: Source, scene: Scene, output: Path, layout: Layout) -> None:
    """Print the commands that train a written scene, and what some of them need first."""
    if not scene.images:  # writing it said so
        return
    if missing := untrainable(scene):
        print_note(missing)
        return
    lenses = distorted_lenses(scene)
    known = lenses <= COMMON_LENSES
    if known:
        trainers = training_commands(output, layout, lenses)
        print_next(trainers, "train it with")
        if "graphdeco" in dict(trainers) and (off := off_centre(scene)) > CENTRED:
            text = (
                f"graphdeco's trainer ignores principal points, which are up to {off:.1f} px off "
            )
            text += (
                "the photographs' centres: it trains as if they were there. The others read them."
            )
            print_note(Finding("off-centre-principal-points", text))
    if lenses:
        text = f"{'The other trainers' if known else 'Trainers'} need photographs without lens "
        text += f"distortion: begin with {source.undistortion}, and upsample that scene."
        print_note(Finding("lens-distortion", text, "info"))


def distorted_lenses(scene: Scene) -> frozenset[str]:
    """Return the camera models of a scene that have distortion."""
    lenses = (image.intrinsics for image in scene.images)
    return frozenset(lens.model for lens in lenses if lens.has_distortion)


def off_centre(scene: Scene) -> float:
    """Return the largest distance of a principal point from its photograph's centre, in pixels."""
    sizes = np.array([(im.camera.width, im.camera.height) for im in scene.images])
    points = np.array([im.camera.K[:2, 2] for im in scene.images])
    return float(np.linalg.norm(points - sizes / 2, axis=1).max(initial=0.0))


def training_commands(path: Path, layout: Layout, lenses: frozenset[str] = frozenset()) -> Commands:
    """Return (trainer, command) for every trainer that reads the scene at ``path`` unchanged.

    ``lenses``: its camera models with distortion.

    Example:
        >>> dict(training_commands(Path("/data/out"), "colmap"))["graphdeco"]
        'python train.py -s /data/out -m /data/out-graphdeco --eval'
    """
    # Other trainers are run from their own checkouts, so a relative path would miss.
    full = path.resolve()
    scene = quoted(full)
    result = [quoted(f"{full}-{name}") for name in ("gsplat", "graphdeco", "lichtfeld", "spirula")]
    gsplat = f"--data_dir {scene} --data_factor 1 --result_dir {result[0]}"
    alone = layout == "colmap"  # nerfstudio looks for transforms.json unless it is told otherwise
    folder = " colmap --colmap-path sparse/0 --downscale-factor 1" if alone else ""
    undistort = " --undistort" if lenses else ""
    commands = {
        "splatseed": f"splatseed train {quoted(path)} -o {quoted(f'{path}-run')}",
        "gsplat": f"python examples/simple_trainer.py default {gsplat}",
        "graphdeco": f"python train.py -s {scene} -m {result[1]} --eval",
        "nerfstudio": f"ns-train splatfacto --data {scene}{folder}",
        "Brush": f"brush {scene} --with-viewer",
        "OpenSplat": f"./opensplat {scene} -n 30000",
        "LichtFeld": f"./build/LichtFeld-Studio -d {scene} -o {result[2]}{undistort}",
        "Spirula": f"spirula train --data {scene} --output-dir-prefix {result[3]}",
    }
    unable = {name for name, handled in LENSES.items() if not lenses <= handled}
    unable |= COLMAP_ONLY if layout == "transforms" else frozenset()
    return [(name, command) for name, command in commands.items() if name not in unable]
