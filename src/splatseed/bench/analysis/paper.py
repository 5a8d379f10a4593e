"""The paper's own numbers, for comparison with ours.

Notation: a *dataset* is Mip-NeRF360 or Replica; an *entry* is a method and its ratio, ``("sfm",
1.0)`` for the original cloud. Promise: the numbers are those of the paper's tables 1 to 3. They are
from 30,000 steps and, for Mip-NeRF360, photographs at a quarter (outdoors) or half (indoors) of
their size; their spread between runs is unknown.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

PAPER_STEPS = 30_000
DATASETS = {"mipnerf360": "Mip-NeRF360", "replica": "Replica"}
PSNR_FILES = {"mipnerf360": "table1_mipnerf360_psnr.csv", "replica": "table2_replica_psnr.csv"}
COST_FILE = "table3_time_size.csv"

Entry = tuple[str, float]


@dataclass(frozen=True)
class PaperCost:
    """Means over a dataset's scenes: training time in seconds, model size in MB."""

    train_seconds: float
    model_megabytes: float


@dataclass(frozen=True)
class PaperDataset:
    """The paper's results on a dataset.

    Args:
        key: As in ``DATASETS``.
        psnr: PSNR in dB by scene and entry.
        costs: By entry; not of all entries that ``psnr`` has.
    """

    key: str
    psnr: Mapping[str, Mapping[Entry, float]]
    costs: Mapping[Entry, PaperCost]

    @property
    def title(self) -> str:
        """The dataset's name."""
        return DATASETS[self.key]

    def gain(self, scene: str, entry: Entry) -> float | None:
        """PSNR of an entry on a scene less that of the cloud as it is, dB; None where unknown.

        Args:
            scene: The scene's name.
            entry: Method and ratio.
        """
        scores = self.psnr.get(scene, {})
        return scores[entry] - scores["sfm", 1.0] if entry in scores else None


@cache
def paper_dataset(key: str) -> PaperDataset:
    """The paper's numbers of a dataset.

    Args:
        key: As in ``DATASETS``.

    Example:
        >>> paper_dataset("mipnerf360").psnr["bonsai"]["sfm", 1.0]
        32.291
    """
    psnr: dict[str, dict[Entry, float]] = {}
    for row in _read(PSNR_FILES[key]):
        entry = row["method"], float(row["ratio"])
        psnr.setdefault(row["scene"], {})[entry] = float(row["psnr_db"])
    costs = {
        (row["method"], float(row["ratio"])): PaperCost(
            float(row["train_time_s"]), float(row["model_size_mb"])
        )
        for row in _read(COST_FILE)
        if row["dataset"] == key
    }
    return PaperDataset(key, psnr, costs)


def dataset_of(scene: str) -> PaperDataset | None:
    """The paper's dataset that has a scene of this name; None if neither has.

    Args:
        scene: The scene's name.
    """
    datasets = (paper_dataset(key) for key in DATASETS)
    return next((each for each in datasets if scene in each.psnr), None)


def _read(name: str) -> list[dict[str, str]]:
    text = (files("splatseed.bench.analysis") / "data" / name).read_text("utf-8")
    return list(csv.DictReader(text.splitlines()))
