"""Runs that begin with the same seeds: the training of one serves the other.

If a budget leaves no room for new points, every method ends up with the same thinned originals; on
the CPU the same seeds and settings give the same bytes. Notation: ``BENCH/twins/PRINT`` names the
run that was trained from the seeds and settings of that fingerprint. Promise: training is reused
only from a run whose files are complete, and the result says from which; never on a GPU, where
bytes differ.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from splatseed.bench.planning.records import RunResult, RunSpec
from splatseed.bench.running.kept import RESULT, read_result
from splatseed.io.files import read_file, read_text
from splatseed.io.staging import MANIFEST, atomic_file
from splatseed.pointcloud import PointCloud
from splatseed.train.seeds import seeds_digest, usable_seeds

TWINS = "twins"


def fingerprint(spec: RunSpec, seeds: PointCloud) -> str:
    """The fingerprint of a run's training: 32 hexadecimal digits, or empty if bytes may differ.

    Args:
        spec: The run.
        seeds: The points it begins with.
    """
    if spec.training.backend != "cpu":
        return ""
    settings = vars(spec.settings)
    used = seeds_digest(usable_seeds(seeds, spec.settings, lambda _: None))
    told = json.dumps([spec.scene_digest, spec.version, settings, used], sort_keys=True)
    return hashlib.blake2b(told.encode(), digest_size=16).hexdigest()


def find_twin(
    target: Path, mark: str, seconds: float, *, models: bool, lpips: bool
) -> tuple[RunResult, Mapping[str, bytes]] | None:
    """The result and files of a run with the same training; None if there is none.

    Args:
        target: The folder for what is kept of the run at hand.
        mark: Its ``fingerprint``.
        seconds: Seconds that making its seeds took.
        models: Whether the trained Gaussians must be among the files.
        lpips: Whether LPIPS must have been measured.
    """
    with suppress(OSError):
        key = read_text(_folder(target) / mark).strip() if mark else ""
        kept = target.parent / key
        result = read_result(kept, key) if key and key != target.name else None
        if result is None or (lpips and result.lpips is None):
            return None
        files = {
            path.relative_to(kept).as_posix(): read_file(path)
            for path in kept.rglob("*")
            if path.is_file() and path.name not in {RESULT, MANIFEST}
        }
        if models and not any(name.endswith(".ply") for name in files):
            return None
        return replace(result, upsample_seconds=seconds, twin=result.twin or key), files
    return None


def note_training(target: Path, mark: str) -> None:
    """Record whose training this was, for future runs.

    Raises:
        OutputError: It cannot be written.
    """
    if mark:
        _folder(target).mkdir(parents=True, exist_ok=True)
        with atomic_file(_folder(target) / mark) as partial:
            partial.write_text(target.name + "\n", "utf-8")


def _folder(target: Path) -> Path:
    """Where a benchmark that keeps a run in ``target`` knows its trainings."""
    return target.parent.parent / TWINS
