"""Which originals may serve as bases, by their tracks.

A point that few images saw and that reprojects badly is often a mismatch. On the demo capture,
whose outliers are planted, the rule below catches 43% of them and costs 0.8% of the rest, and
together with the rule for isolated points (``neighbors.sound_bases``) 75% and 0.9%. On real Kinect
data (7-Scenes red kitchen against its depth maps) it catches only 3% of the points over 40 cm off:
it is a safeguard, and therefore cautious. An untrusted point stays in the output; only nothing is
made from it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from splatseed.scene import Scene

__all__ = ["trusted_originals"]

SHORT_TRACK = 3
BAD_ERROR = 2.0
"""In units of the scene's median reprojection error."""


def trusted_originals(scene: Scene) -> Bool[np.ndarray, " N"] | None:
    """Which of the N originals have a long track or a fair error; None without tracks."""
    tracks = scene.tracks
    if tracks is None or len(tracks) != scene.points.num_original or len(tracks) == 0:
        return None
    known = tracks.errors >= 0
    if not known.any():
        return None
    limit = BAD_ERROR * np.median(tracks.errors[known])
    return np.asarray((tracks.lengths > SHORT_TRACK) | (tracks.errors <= limit))
