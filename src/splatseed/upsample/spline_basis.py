"""The cubic B-spline basis and its roughness penalty, computed once.

Notation: C = 6 control values a side on the domain [-1, 1] (3 uniform intervals), coefficients
c[a, b] stored as c[6 a + b]; S(u, v) = sum_ab B_a(u) B_b(v) c[a, b].
The penalty is a discrete thin plate (P. Eilers, B. Marx, Flexible smoothing with B-splines and
penalties, 1996, with the cross term of a thin plate): D2'D2 x I + 2 D1'D1 x D1'D1 + I x D2'D2. Its
null space is the planes, so that strong smoothing tends to the best plane.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

__all__ = ["CONTROL", "penalty", "penalty_inverse"]

CONTROL = 6


def penalty() -> Float64[np.ndarray, "36 36"]:
    """The penalty matrix P, so that roughness = c' P c."""
    identity = np.eye(CONTROL)
    first = np.diff(identity, axis=0)
    second = np.diff(identity, n=2, axis=0)
    slopes, bends = first.T @ first, second.T @ second
    return np.kron(bends, identity) + 2.0 * np.kron(slopes, slopes) + np.kron(identity, bends)


def penalty_inverse() -> Float64[np.ndarray, "36 36"]:
    """The pseudo-inverse of P."""
    return np.ascontiguousarray(np.linalg.pinv(penalty(), hermitian=True))
