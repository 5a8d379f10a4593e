"""The contract of upsampling methods: a frozen dataclass of parameters that can be called.

A method gets the scene, the number of points to make and a random generator, and returns positions
in the world and colours. Methods that start from the originals get them clean, centred and with
their neighbours from ``neighbors.prepare_scene``. Putting originals first, counting and the origin
of points are handled once, around the method.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.errors import PointCloudError
from splatseed.progress import Progress
from splatseed.scene import Scene

if TYPE_CHECKING:
    from splatseed.depth.stereo.maps import StereoResult


class NewPoints(NamedTuple):
    """New points with their attributes, NaN where unknown."""

    xyz: Float32[np.ndarray, "M 3"]  # world
    rgb: UInt8[np.ndarray, "M 3"]
    notes: tuple[str, ...] = ()  # for the user, one sentence each
    normals: Float32[np.ndarray, "M 3"] | None = None  # unit, world axes
    sizes: Float32[np.ndarray, " M"] | None = None  # initial radius of a Gaussian, scene units
    confidence: Float32[np.ndarray, " M"] | None = None  # that a surface is there, 0 to 1
    source: UInt8[np.ndarray, " M"] | None = None  # codes of their methods, never 0; None: its own
    stereo: StereoResult | None = None  # of methods that compare the photographs


Need = Literal["points", "depth", "photographs", "cloud"]


@dataclasses.dataclass(frozen=True)
class Traits:
    """The inputs that a method needs, and whether it chooses the number of points itself.

    Such a method is called with ``num_new`` 0.
    """

    needs: frozenset[Need] = frozenset({"points"})
    chooses_number: bool = False


@runtime_checkable
class Upsampler(Protocol):
    """An upsampling method. Third parties register classes under ``splatseed.methods``.

    Three members are optional. ``traits`` (``Traits``) is for a method that needs more than points,
    or chooses the number of new points itself. ``paper()``, a class method, gives the parameters
    that follow a paper to the letter; without it both profiles are the same.
    ``suggested_number(scene)`` gives the number of new points for a scene without originals, of
    which no ratio is a multiple.
    """

    def __call__(
        self, scene: Scene, num_new: int, rng: np.random.Generator, progress: Progress
    ) -> NewPoints:
        """Make exactly ``num_new`` finite points for a scene.

        All random numbers come from ``rng``; ``progress`` is called with stage and fraction.
        """
        ...


def traits_of(method: Upsampler) -> Traits:
    """Return a method's traits, or the default ones."""
    traits: Traits = getattr(method, "traits", Traits())
    return traits


def nothing_finite(number: int) -> PointCloudError:
    """Make the error for a cloud of ``number`` points without a finite original."""
    return PointCloudError(
        "at least one original point with finite coordinates",
        found=f"{number} points, none of them finite and original",
        fix="Check that the scene holds points from Structure-from-Motion or a scan.",
    )
