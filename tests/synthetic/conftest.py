"""A small capture, made once."""

from __future__ import annotations

import pytest

from splatseed.synthetic import Capture, make_capture


@pytest.fixture(scope="package")
def capture() -> Capture:
    return make_capture(seed=0, num_views=14, width=200, height=150)
