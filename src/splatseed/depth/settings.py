"""How pixels are lifted: every choice of the method, each of which can be turned off.

A ``Settings`` is the method's parameters; the flags of the command line are its fields.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Settings:
    """The choices of depth-guided lifting; the defaults avoid the traps of the paper's text."""

    align: bool = True
    """Fit the scale (for inverse depth, and shift) of each map to the SfM points."""
    fit: Literal["robust", "least-squares"] = "robust"
    """How to fit: medians and reweighting, or the paper's equation 7 (paper: least-squares)."""
    min_points: int = 20
    """Fewest SfM points that an image must see, else it is left out (paper: 1)."""
    max_residual_ratio: float | None = 3.0
    """Leave out images that fit this many times worse than the median one (paper: none)."""
    synchronize_scales: bool = True
    """Then scale the maps, each by one factor, to agree with each other (paper: no)."""
    unit_ray: bool = False
    """Take z for the distance along the ray, as equation 9 says; this bends walls (paper: yes)."""
    region: float = 1.0
    """Central fraction of the width and of the height that pixels are drawn from (paper: 0.5)."""
    placement: Literal["empty", "uniform"] = "empty"
    """Draw pixels by their distance to the nearest SfM point, or uniformly (paper: uniform)."""
    edge_tolerance: float | None = 0.03
    """Avoid pixels near discontinuities larger than this fraction of depth (paper: none)."""
    edge_radius: int = 3
    """Radius of the discontinuity test, in pixels of the map."""
    min_agreeing: int = 2
    """Other views whose depth and colour must confirm a point; 0 = none (paper: 0)."""
    see_through: bool = False
    """Keep points that another view looks through (paper: yes)."""
    num_neighbors: int = 12
    """Most other views that are compared with a point."""
    tolerance: float = 0.02
    """Relative difference up to which two depths agree."""
    color_tolerance: float | None = 0.15
    """Mean colour difference, 0 to 1, up to which two views agree; none = not compared."""
    spread: bool = True
    """Spread points as evenly as their number allows, whatever image they come from (paper:
    no)."""
    hold_out: int = 0
    """Leave out every n-th image by name, as trainers do for testing (8); 0 = use all."""

    @property
    def synchronizes(self) -> bool:
        """Whether maps are scaled to agree with each other; maps in scene units are left alone."""
        return self.align and self.synchronize_scales

    @property
    def compares_views(self) -> bool:
        """Whether points are compared with other views at all."""
        return self.min_agreeing > 0 or not self.see_through
