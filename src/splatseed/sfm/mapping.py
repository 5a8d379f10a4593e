"""Estimate poses, lenses and points of the photographs whose matches are in a run's database.

Incremental mapping comes first. Where its poses contradict the matches, as happens if photographs
are placed beside others that merely look alike, all are mapped at once, too (COLMAP's global
mapper), and the poses that explain more of the matches are kept.

Notation: a ``model`` is a ``pycolmap.Reconstruction``; models are in numbered folders.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from splatseed import errors
from splatseed.io.staging import remove
from splatseed.sfm.colmap import Run, mapping_options
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
_MAX_ERROR = 4.0  # px between a match and its epipolar line, as in COLMAP's verification of pairs
_SIMPLE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL")


def map_images(
    run: Run,
    names: Sequence[str],
    camera_model: str,
    match_further: Callable[[Collection[str]], bool] | None,
    *,
    partial: bool,
) -> Path:
    """Estimate poses, lenses and points; return the folder of the model with the most images.

    ``match_further`` matches further pairs of photographs without a pose, by name, and returns
    whether some match; then mapping goes on. None if all pairs of the matcher are matched.

    Raises:
        ReconstructionError: No model, or one of fewer than half of the photographs while
            ``partial`` is False.
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
    return models_dir / str(best)


def _mapped(
    run: Run,
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
    share = explained(run, models[best]) if models else 0.0
    if share < _EXPLAINED:
        models |= _map_globally(run, models_dir, best, share, names)
    remove(models_dir / _SNAPSHOTS)
    (models_dir / COMPLETE).touch()
    return models


def _map(
    run: Run, stage: str, folder: Path, total: int, given: Path | None = None
) -> dict[int, Any]:
    """Map images to models in numbered folders, or extend a given model in ``folder`` itself."""
    registered: list[None] = []  # except initial pairs
    options = mapping_options(run)
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWTH
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = _TOLERANCE
    if run.kept is not None:
        options.snapshot_path = run.kept.folder / MODELS / _SNAPSHOTS
        options.snapshot_path.mkdir(exist_ok=True)
        options.snapshot_frames_freq = _SNAPSHOT_FRAMES
    models: dict[int, Any] = run.stage(
        stage,
        lambda: run.pycolmap.incremental_mapping(
            *(run.database, run.image_dir, folder, options),
            **({} if given is None else {"input_path": given}),
            next_image_callback=lambda: registered.append(None),
        ),
        lambda: len(registered),
        total,
    )
    return models


def _extend(run: Run, stage: str, given: Path, folder: Path, total: int) -> Any:
    """Go on mapping from a given model, and write the result to ``folder``."""
    extended = folder.with_name("extended")
    extended.mkdir()
    (model,) = _map(run, stage, extended, total, given).values()
    remove(folder)
    extended.rename(folder)
    return model


def _map_globally(
    run: Run, models_dir: Path, number: int, share: float, names: Sequence[str]
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
        if found is None or explained(run, found[1]) <= share:
            return {}
        remove(models_dir / str(number))
        found[0].rename(models_dir / str(number))
        return {number: found[1]}
    finally:
        remove(folder)


def _map_at_once(run: Run, folder: Path, total: int) -> tuple[Path, Any] | None:
    """Return the largest model of COLMAP's global mapper, and its folder; None without one."""
    pycolmap, settings = run.pycolmap, run.settings
    options = pycolmap.GlobalPipelineOptions(
        num_threads=settings.threads, random_seed=settings.seed
    )
    try:
        models = run.stage(
            "global mapping",
            lambda: pycolmap.global_mapping(run.database, run.image_dir, folder, options),
            lambda: 0,
            1,
        )
        if not models:
            return None
        mapped = folder / str(_largest(models))
        return mapped, _extend(run, "further mapping", mapped, mapped, total)
    except errors.ReconstructionError:
        return None  # the models of incremental mapping are reported


def explained(run: Run, model: Any) -> float:
    """Return the share of the verified matches that a model's poses explain.

    Those of photographs without a pose count as well. A match is explained if its points are
    within ``_MAX_ERROR`` of their epipolar lines (Sampson's error).
    """
    pycolmap = run.pycolmap
    agreeing = total = 0
    with pycolmap.Database.open(run.database) as database:
        posed, rays, limits = {}, {}, {}
        for image in database.read_all_images():
            found = model.find_image_with_name(image.name)
            if found is not None and found.has_pose:
                camera, keypoints = found.camera, database.read_keypoints(image.image_id)
                posed[image.image_id] = found.cam_from_world()
                rays[image.image_id] = camera.cam_from_img(keypoints[:, :2].astype(np.float64))
                limits[image.image_id] = camera.cam_from_img_threshold(_MAX_ERROR)
        pairs, geometries = database.read_two_view_geometries()
    for pair, geometry in zip(map(pycolmap.pair_id_to_image_pair, pairs), geometries, strict=True):
        matches = geometry.inlier_matches
        total += len(matches)
        if not len(matches) or not posed.keys() >= {*pair}:
            continue
        a, b = pair
        essential = pycolmap.essential_matrix_from_pose(posed[b] * posed[a].inverse())
        errors_squared = pycolmap.compute_squared_sampson_error(
            rays[a][matches[:, 0]], rays[b][matches[:, 1]], essential
        )
        limit = max(limits[a], limits[b])
        agreeing += int((np.array(errors_squared) < limit**2).sum())
    return agreeing / max(total, 1)


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
