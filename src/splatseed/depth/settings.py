"""Settings of depth-guided lifting; the defaults avoid the traps of the paper's text."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from splatseed.depthmap import MIN_CONFIDENCE
from splatseed.settings import Range

Fit = Literal["robust", "least-squares"]
"""Medians and reweighting, or the paper's equation 7."""

PER_POINT = 8
"""Pixels of known depth per new point. With fewer, lifting runs out of free pixels away from depth
discontinuities: on stereo's maps of a kitchen with 14% known, one in 8.2 was."""
MAX_VIEWS = 255
"""Other views that a point can be compared with: 8 bits count them."""


@dataclass(frozen=True)
class DepthSettings:
    """Settings of depth-guided lifting."""

    align: bool = True
    """Fit the scale (for inverse depth, and shift) of each map to the SfM points. Without points,
    maps that come with a capture, in its unit, are used as they are."""
    min_confidence: Annotated[int, Range(0, 2)] = MIN_CONFIDENCE
    """Use depth from this confidence on, where maps have one: 0 low, 1 medium, 2 high."""
    fit: Fit = "robust"
    """How to fit: medians and reweighting, or the paper's equation 7 (paper: least-squares)."""
    min_points: Annotated[int, Range(1)] = 20
    """SfM points that an image needs on known depth, else it is left out (paper: 1)."""
    max_residual_ratio: Annotated[float | None, Range(1)] = 3.0
    """Leave out images that fit this many times worse than the median one (paper: none)."""
    synchronize_scales: bool = True
    """Then scale the maps, each by one factor, to agree with each other (paper: no)."""
    unit_ray: bool = False
    """Take z for the distance along the ray, as in equation 9; this bends walls (paper: yes)."""
    central_fraction: Annotated[float, Range(above=0, maximum=1)] = 1.0
    """Draw pixels from this fraction of the width and of the height, around the centre (paper:
    0.5)."""
    placement: Literal["empty", "uniform"] = "empty"
    """Draw pixels by their distance to the nearest SfM point, or uniformly (paper: uniform)."""
    edge_tolerance: Annotated[float | None, Range(above=0)] = 0.03
    """Avoid pixels near discontinuities larger than this fraction of depth (paper: none)."""
    edge_radius: Annotated[int, Range(1, 100)] = 3
    """Radius of the discontinuity test, in pixels of the map."""
    min_agreeing: Annotated[int, Range(0, "num_neighbors")] = 2
    """Other views whose depth and colour must confirm a point; 0 = none (paper: 0)."""
    see_through: bool = False
    """Keep points that another view sees through (paper: yes)."""
    num_neighbors: Annotated[int, Range(1, MAX_VIEWS)] = 12
    """Other views compared with a point, at most."""
    tolerance: Annotated[float, Range(above=0, below=1)] = 0.02
    """Relative difference up to which two depths agree."""
    color_tolerance: Annotated[float | None, Range(above=0, maximum=1)] = 0.15
    """Mean colour difference, 0 to 1, up to which two views agree; none = not compared."""
    spread: bool = True
    """Spread points as evenly as their number allows, whatever image they come from (paper:
    no)."""
    test_every: Annotated[int, Range(2, also=0)] = 0
    """Leave out every n-th image by name, as trainers do for testing (8); 0 = use all but
    test images that the scene lists."""

    @property
    def synchronizes(self) -> bool:
        """Whether maps are scaled to agree with each other; maps in scene units are not."""
        return self.align and self.synchronize_scales

    @property
    def compares_views(self) -> bool:
        """Whether points are compared with other views."""
        return self.min_agreeing > 0 or not self.see_through
