"""What every upsampling method is: a frozen dataclass of parameters that can be called.

A method gets the prepared originals, the number of points to make and a random generator, and
returns positions in the world and colours. All else (masking, de-duplication, putting originals
first) is done once, around it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.errors import ParameterError
from splatseed.progress import Progress

if TYPE_CHECKING:  # SciPy and Numba load with the first method, not with the package
    from splatseed.upsample.neighbors import PreparedCloud

__all__ = ["NewPoints", "Upsampler", "require"]


class NewPoints(NamedTuple):
    """What a method returns."""

    xyz: Float32[np.ndarray, "M 3"]
    """World positions, float32 [M, 3]."""
    rgb: UInt8[np.ndarray, "M 3"]
    """Colours, uint8 [M, 3]."""


@runtime_checkable
class Upsampler(Protocol):
    """An upsampling method. Third parties register classes under ``splatseed.methods``."""

    def __call__(
        self, cloud: PreparedCloud, num_new: int, rng: np.random.Generator, progress: Progress
    ) -> NewPoints:
        """Make exactly ``num_new`` finite points from the prepared originals.

        Every random number comes from ``rng``; ``progress`` is told the stages.
        """
        ...

    @classmethod
    def paper(cls) -> Self:
        """The parameters that follow the paper to the letter."""
        ...


def require(condition: bool, expected: str, found: object) -> None:
    """Check a method's parameter.

    Raises:
        ParameterError: ``condition`` does not hold.
    """
    if not condition:
        raise ParameterError(expected, found=repr(found), fix="Choose a value in that range.")
