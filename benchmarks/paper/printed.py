"""The numbers that the paper prints: PSNR (tables 1 and 2), time and size (table 3)."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pandas as pd

__all__ = ["printed_costs", "printed_gains", "printed_psnr"]

FOLDER = Path(__file__).with_name("data")
FILES = {"mipnerf360": "table1_mipnerf360_psnr.csv", "replica": "table2_replica_psnr.csv"}


@cache
def printed_psnr(dataset: str) -> pd.DataFrame:
    """PSNR in dB after 30,000 steps: a row per scene, a column per (method, ratio).

    Example:
        >>> float(printed_psnr("mipnerf360").loc["bonsai", ("sfm", 1.0)])
        32.291
    """
    return pd.read_csv(FOLDER / FILES[dataset], dtype={"ratio": float}).pivot_table(
        index="scene", columns=["method", "ratio"], values="psnr_db", sort=False
    )


@cache
def printed_gains(dataset: str) -> pd.DataFrame:
    """PSNR minus that of the SfM points, in dB."""
    table = printed_psnr(dataset)
    return table.drop(columns=[("sfm", 1.0)]).sub(table["sfm", 1.0], axis=0)


def printed_costs(dataset: str) -> pd.DataFrame:
    """``train_time_s`` and ``model_size_mb`` per (method, ratio); table 3 lacks some of them."""
    table = pd.read_csv(FOLDER / "table3_time_size.csv", dtype={"ratio": float})
    return table[table["dataset"] == dataset].set_index(["method", "ratio"])
