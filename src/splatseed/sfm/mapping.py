"""Estimate poses, lenses and points of the photographs whose matches are in a run's database.

Incremental mapping comes first. It may place photographs beside others that merely look alike, and
its poses then contradict matches. If they contradict those between two parts of the photographs,
the smaller part is mapped again; if they still contradict many, all are mapped at once, too
(COLMAP's global mapper), and the poses that explain more of the matches are kept.

Notation: a ``model`` is a ``pycolmap.Reconstruction``; models are in numbered folders.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from sqlite3 import connect
from typing import Any

from splatseed import errors
from splatseed.findings import Finding
from splatseed.io.staging import remove
from splatseed.sfm.agreement import Agreement, compare_with_matches
from splatseed.sfm.colmap import ColmapRun, mapping_options
from splatseed.sfm.work_folder import COMPLETE, MODELS
from splatseed.text import counted, name_some

_SNAPSHOTS = "snapshots"  # folder of models amid mapping
_SNAPSHOT_FRAMES = 50  # photographs mapped between two of them
_GROWTH = 1.25  # of the model between global adjustments; COLMAP's 1.1 takes 1.4 times as long
_TOLERANCE = 1e-6  # relative change of cost that ends an adjustment; 0 takes 1.3 times as long
_EXPLAINED = 0.95
"""Share of the matches that the poses of a sound model explain: 0.998 or more on captures without
repeated patterns; of bonsai's every third photograph wrong poses explain 0.69 to 0.76, right ones
0.90 to 0.93."""
_LINK = 0.5
"""The same of the matches between any two parts: of all 292 photographs of bonsai, 0.95 of the
matches agree with poses that displace 107 photographs, but 0.13 of those that link them to the
others. The weakest link of right poses has 0.78 (bonsai) to 0.997, on eight captures."""
_RELINKED = 3  # parts that are mapped again at most
_SIMPLE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL")


def map_images(
    run: ColmapRun,
    names: Sequence[str],
    camera_model: str,
    match_further: Callable[[Collection[str]], bool] | None,
    *,
    partial: bool,
) -> tuple[Path, Finding | None]:
    """Estimate poses, lenses and points.

    Returns the folder of the model with the most images, and why its poses may be wrong (None if
    the matches agree with them).

    ``match_further`` matches further pairs of photographs without a pose, by name, and returns
    whether some match; then mapping goes on. None if all pairs of the matcher are matched.
    """
    models_dir = (run.kept.folder if run.kept else run.work) / MODELS
    models = _mapped(run, models_dir, names, match_further)
    more = ["take more overlapping photographs", "remove those of other places"]
    chosen = match_further is not None or run.settings.matcher == "sequential"
    if chosen and run.num_pairs() < math.comb(len(names), 2):
        more.append("match all pairs with `matcher='exhaustive'`")
    if camera_model not in _SIMPLE:
        more.append("use a simpler camera model such as SIMPLE_RADIAL")
    advice = f"{', '.join(more[:-1])} or {more[-1]}"
    if run.kept:
        advice = f"{advice}; features and matches are kept in {run.kept.folder}"
    if not models:
        raise errors.ReconstructionError(
            f"a model of the {len(names)} photographs",
            found="no two that match well enough to start one",
            fix=f"{advice[0].upper()}{advice[1:]}.",
        )
    best = _largest(models)
    found = _posed(models[best])
    if 2 * len(found) < len(names) and not partial:
        raise errors.ReconstructionError(
            f"at least half of the {len(names)} photographs to get a pose",
            found=f"{len(found)} in the largest of {counted(len(models), 'model')}; "
            f"without a pose: {name_some([name for name in names if name not in found])}",
            fix=f"Pass `partial=True` to write the scene of these {len(found)}. For more, "
            f"{advice}.",
        )
    return models_dir / str(best), _contradiction(compare_with_matches(run, models[best]))


def _contradiction(found: Agreement) -> Finding | None:
    if found.link >= _LINK:
        return None
    named = name_some(found.part)
    return Finding(
        "contradicted-poses",
        f"The poses contradict {1 - found.link:.0%} of the matches between {len(found.part):,} of "
        f"the photographs ({named}) and the others: one of these two parts is probably misplaced.",
        subjects=tuple(found.part),
        fix="Check their cameras (splatseed view), and take photographs of what lies between the "
        "two.",
    )


def _mapped(
    run: ColmapRun,
    models_dir: Path,
    names: Sequence[str],
    match_further: Callable[[Collection[str]], bool] | None,
) -> dict[int, Any]:
    """Map images, or load the finished models of an earlier run; return models by number."""
    if (models_dir / COMPLETE).exists():
        folders = (path for path in models_dir.iterdir() if path.is_dir())
        return {int(path.name): run.pycolmap.Reconstruction(path) for path in folders}
    snapshot = _snapshot(models_dir / _SNAPSHOTS)
    for path in models_dir.iterdir() if models_dir.is_dir() else ():
        if path.name != _SNAPSHOTS:
            remove(path)
    models_dir.mkdir(exist_ok=True)
    if snapshot is None:
        models = _map(run, "mapping", models_dir, len(names))
    else:
        models = {0: _extend(run, "mapping", snapshot, models_dir / "0", len(names))}
    best = _largest(models)
    lost = sorted({*names} - _posed(models[best])) if models else list(names)
    if lost and match_further is not None and match_further(lost):
        if models:  # goes on from the largest model, whose photographs keep their matches
            folder = models_dir / str(best)
            models[best] = _extend(run, "further mapping", folder, folder, len(lost))
        else:
            models = _map(run, "further mapping", models_dir, len(names))
    best = _largest(models)
    found = compare_with_matches(run, models[best]) if models else Agreement(0.0, 0.0, (), ())
    for _ in range(_RELINKED):
        relinked = _relinked(run, models_dir, best, found) if found.link < _LINK else None
        if relinked is None:
            break
        models[best], found = relinked
    if found.explained < _EXPLAINED or found.link < _LINK:
        models |= _map_globally(run, models_dir, best, found.explained, names)
    remove(models_dir / _SNAPSHOTS)
    (models_dir / COMPLETE).touch()
    return models


def _map(
    run: ColmapRun, stage: str, folder: Path, total: int, given: Path | None = None
) -> dict[int, Any]:
    """Map images to models in numbered folders, or extend a given model in ``folder`` itself."""
    registered: list[None] = []  # except initial pairs
    options = mapping_options(run)
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWTH
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = _TOLERANCE
    options.ba_refine_focal_length = not run.holds_focal
    if run.kept is not None:
        options.snapshot_path = run.kept.folder / MODELS / _SNAPSHOTS
        options.snapshot_path.mkdir(exist_ok=True)
        options.snapshot_frames_freq = _SNAPSHOT_FRAMES
    models: dict[int, Any] = run.stage(
        stage,
        lambda: run.pycolmap.incremental_mapping(
            *(run.database, run.readable, folder, options),
            **({} if given is None else {"input_path": given}),
            next_image_callback=lambda: registered.append(None),
        ),
        lambda: len(registered),
        total,
    )
    return models


def _extend(run: ColmapRun, stage: str, given: Path, folder: Path, total: int) -> Any:
    """Go on mapping from a given model, and write the result to ``folder``."""
    extended = folder.with_name("extended")
    extended.mkdir()
    (model,) = _map(run, stage, extended, total, given).values()
    remove(folder)
    extended.rename(folder)
    return model


def _relinked(
    run: ColmapRun, models_dir: Path, number: int, found: Agreement
) -> tuple[Any, Agreement] | None:
    """Map the part again that is linked to the others by few matches that agree with its place.

    Without these matches its photographs are placed by all the others. Returns the model and its
    agreement if it explains more, and then replaces model ``number``; else None.
    """
    given = models_dir / str(number)
    if not found.agreeing:
        return None
    folder = models_dir / "relinked"
    folder.mkdir()
    try:
        alone = replace(run, kept=None, work=folder)
        with closing(connect(run.database)) as source, closing(connect(alone.database)) as copy:
            source.backup(copy)
        model = run.pycolmap.Reconstruction(given)
        for frame_id in {model.find_image_with_name(name).frame_id for name in found.part}:
            model.deregister_frame(frame_id)
        (rest := folder / "rest").mkdir()
        model.write(rest)
        with run.pycolmap.Database.open(alone.database) as database:
            ids = {image.name: image.image_id for image in database.read_all_images()}
            for a, b in found.agreeing:
                database.delete_two_view_geometry(ids[a], ids[b])
        model = _extend(alone, "further mapping", rest, rest, len(found.part))
        agreement = compare_with_matches(run, model)
        if agreement.explained <= found.explained:
            return None
        remove(given)
        rest.rename(given)
        return model, agreement
    finally:
        remove(folder)


def _map_globally(
    run: ColmapRun, models_dir: Path, number: int, share: float, names: Sequence[str]
) -> dict[int, Any]:
    """Map all images at once; return the model by its number if it explains more than ``share``.

    That needs no initial pair, on which incremental mapping fails where a wrong focal length fits
    two photographs as well, and averages rotations over all pairs, so that wrong ones are outvoted.
    The result is held to incremental mapping's criteria, and takes the place of that model.
    """
    folder = models_dir / "global"
    folder.mkdir()
    try:
        found = _map_at_once(run, folder, len(names))
        if found is None or compare_with_matches(run, found[1]).explained <= share:
            return {}
        remove(models_dir / str(number))
        found[0].rename(models_dir / str(number))
        return {number: found[1]}
    finally:
        remove(folder)


def _map_at_once(run: ColmapRun, folder: Path, total: int) -> tuple[Path, Any] | None:
    """Return the largest model of COLMAP's global mapper, and its folder; None without one."""
    pycolmap, settings = run.pycolmap, run.settings
    options = pycolmap.GlobalPipelineOptions(
        num_threads=settings.threads, random_seed=settings.seed
    )
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length = not (run.holds_focal or run.rigs)
    if run.rigs:  # it can hold no camera alone: what is mapped after it refines the others
        adjustment.refine_extra_params = adjustment.refine_sensor_from_rig = False
        options.mapper.refine_sensor_from_rig = False
    try:
        models = run.stage(
            "global mapping",
            lambda: pycolmap.global_mapping(run.database, run.readable, folder, options),
            lambda: 0,
            1,
        )
        if not models:
            return None
        mapped = folder / str(_largest(models))
        return mapped, _extend(run, "further mapping", mapped, mapped, total)
    except errors.ReconstructionError:
        return None  # the models of incremental mapping are reported


def _snapshot(folder: Path) -> Path | None:
    """Return the last model but one that a killed run wrote amid mapping: the last may be cut."""
    files = folder.iterdir() if folder.is_dir() else ()
    written = sorted(files, key=lambda path: path.stat().st_mtime_ns)
    return written[-2] if len(written) > 1 else None


def _largest(models: Mapping[int, Any]) -> int:
    """Return the number of the model with the most images, then points."""
    sizes = {i: (model.num_reg_images(), model.num_points3D()) for i, model in models.items()}
    return max(sizes, key=lambda i: sizes[i], default=0)


def _posed(model: Any) -> set[str]:
    return {image.name for image in model.images.values() if image.has_pose}
