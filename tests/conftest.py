"""Fixtures shared by all tests."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest

SCENES = Path(os.environ.get("SPLATSEED_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))


@pytest.fixture(autouse=True)
def _untold_compilation(monkeypatch):
    """What commands say on stderr must not depend on what is compiled already."""
    monkeypatch.setattr("splatseed.console.TOLD_AFTER", math.inf)


def pytest_collection_modifyitems(items) -> None:
    """Slow tests last: what fails is known before they begin."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is not None)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def scenes() -> Path:
    """The folder of real captures; tests that need it are skipped on a machine without it."""
    if not SCENES.is_dir():
        pytest.skip(f"real captures not found at {SCENES}; set SPLATSEED_SCENES to their folder")
    return SCENES
