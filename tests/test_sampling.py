"""Samples of sequences."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.sampling import evenly_spaced, strided


@pytest.mark.parametrize("count", [0, 1, 2, 7, 100])
@pytest.mark.parametrize("limit", [1, 2, 5, 24])
def test_evenly_spaced_items_reach_from_the_first_to_the_last(count, limit):
    idx = evenly_spaced(count, limit)
    assert len(idx) == min(count, limit)
    if count <= limit:
        assert idx.tolist() == list(range(count))
    elif limit > 1:
        steps = np.diff(idx)
        assert (idx[0], idx[-1]) == (0, count - 1)
        assert 0 < steps.min() <= steps.max() <= steps.min() + 1


def test_strided_values_are_every_nth():
    assert strided(np.arange(10), 4).tolist() == [0, 3, 6, 9]
    assert strided("abc", 4) == "abc"
    assert strided([], 4) == []
