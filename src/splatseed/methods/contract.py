"""The contract of upsampling methods: a frozen dataclass of parameters that can be called.

A method gets the scene, the number of points to make and a random generator, and returns the new
points. Methods that start from the originals get them clean, centred and with their neighbours from
``neighbors.prepare_scene``. Putting originals first, counting and the origin of points are handled
once, around the method.
"""

from __future__ import annotations

import dataclasses
from typing import Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.errors import PointCloudError
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress
from splatseed.scene import Scene

Made: TypeAlias = PointCloud | tuple[Float32[np.ndarray, "M 3"], UInt8[np.ndarray, "M 3"]]
"""New points, or their positions in the world and colours. Points with ``source`` 0 get the code of
the method; a method that calls others sets theirs."""

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
    ) -> Made:
        """Make exactly ``num_new`` finite points for a scene.

        All random numbers come from ``rng``; ``progress`` is called with stage and fraction.
        A call that has these optional parameters gets them by name: ``note``, to be called with a
        ``Finding`` for each thing that the user should know; ``budget``, the maximum number of
        points in all, or None, for a method that chooses the number; ``region``, which maps
        positions to whether new points are wanted there, or None: others are dropped later;
        ``on_stereo``, to be called with the ``StereoResult`` of a method that compares the
        photographs.
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
