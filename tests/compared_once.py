"""Stereo of the same photographs, found once for all tests and processes of the suite.

Most tests of commands, runs and benchmarks look at one room, which takes seconds to compare.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatseed.checkup import poses
from splatseed.depth.stereo import coarse, matching, pipeline
from splatseed.depth.stereo.maps import StereoResult
from splatseed.io.staging import atomic_file
from splatseed.photos.view import View
from splatseed.progress import Progress

USERS = (coarse, pipeline, poses)
"""The modules that compare photographs."""

_found: dict[bytes, StereoResult] = {}


def match_views(
    folder: Path,
    views: Sequence[View],
    priors: Any,
    sources: Any,
    settings: Any,
    seed: int,
    progress: Progress,
) -> StereoResult:
    """As ``matching.match_views``, whose result follows from all arguments but the progress.

    Results are kept in ``folder`` for the other processes.
    """
    matching.check_stereo_memory(views, settings)
    key = _digest(views, priors, sources, settings, seed)
    kept = folder / key.hex()
    if key not in _found and kept.is_file():
        _found[key] = pickle.loads(kept.read_bytes())  # noqa: S301  (our own)
    if key in _found:
        progress("compare photographs", 1.0)
    else:
        found = matching.match_views(views, priors, sources, settings, seed, progress)
        _found[key] = replace(found, views=())
        with atomic_file(kept) as partial:
            partial.write_bytes(pickle.dumps(_found[key]))
    found, lists = _found[key], ("planes", "costs", "agreeing")
    copies = {name: [each.copy() for each in getattr(found, name)] for name in lists}
    return replace(found, views=tuple(views), **copies)


def _digest(views: Sequence[View], *others: Any) -> bytes:
    content = hashlib.sha256(pickle.dumps(others))
    for view in views:
        mask = b"" if view.mask is None else view.mask.tobytes()
        placed = view.K.tobytes() + view.cam_from_world.tobytes()
        shape = view.photograph.shape, view.name, view.near
        for each in (repr(shape).encode(), view.photograph.tobytes(), mask, placed):
            content.update(hashlib.sha256(each).digest())
    return content.digest()
