"""What the columns of a text cloud without a header are: position, colours, intensity.

The position is columns 1 to 3, or 2 to 4 after a running number. Colours are three columns of one
kind: bytes, integers of up to 16 bits, or numbers from 0 to 1 that are not unit normals. Columns of
few values (labels, returns, a constant alpha) are none. A fourth and last column is intensity.

Four columns of one kind are intensity before or after colours. Which of the two is decided if it is
certain: intensity is an average of red, green and blue (made from the colours), or hardly follows
two channels that follow each other (a laser's). Otherwise both are possible.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from scipy.optimize import nnls

from splatseed.io.cloud_file import RGB, XYZ

_UNIT = 1e-2
"""Largest difference from 1 in the length of a normal."""
_BYTE, _WIDE, _LABEL = 255, 65535, 31
"""Largest integers of 8 and 16 bits, and of labels: LAS has classes of 5 bits."""
_ALIKE = ({"byte", "bit"}, {"unit", "bit"}, {"wide"})
_MIN_ROWS = 100
"""Minimum number of rows whose statistics distinguish columns."""
_FEW, _PER_ROW = 16, 8
"""Most values of a column of labels: so many, and one for so many rows."""
_IN_ORDER = 0.98
"""Share of the rows whose number is one more than that of the row before, in a sample."""
_ROUNDED = 1.0 / _BYTE
"""Largest difference between equal values, relative to white."""
_FOLLOWS, _INDEPENDENT, _PARTIAL = 0.7, 0.5, 0.4
"""Correlations: least among the channels of a colour, largest of a laser's intensity with them, and
largest with the outer channel beyond what the others explain: intensity made from the colours has
more."""


def possible_columns(sample: Float64[np.ndarray, "N C"], *, is_pts: bool) -> list[list[str]]:
    """Name the columns of a sample of rows, in each way that is possible.

    ``is_pts`` for intensity before colours, as in PTS files.
    """
    sample = np.unique(sample, axis=0)
    count, at = sample.shape[1], int(sample.shape[1] > 3 and _is_running(sample[:, 0]))
    names = [f"column {i + 1}" for i in range(count)]
    names[at : at + 3] = XYZ
    if is_pts and count - at == 7 and _are_colors(sample[:, at + 4 :]):
        starts = [at + 4]
    else:
        starts = _color_starts(sample, at + 3)
    if starts:
        return [[*names[:start], *RGB, *names[start + 3 :]] for start in starts]
    if count - at == 4:
        names[at + 3] = "intensity"
    return [names]


def _is_running(column: Float64[np.ndarray, " N"]) -> bool:
    """Whether a sorted column numbers the rows; those of a sample have gaps between its parts."""
    steps = np.diff(column)
    whole = (column == np.rint(column)).all() and len(column) >= 3
    return bool(whole and (steps >= 1).all() and np.mean(steps == 1) >= _IN_ORDER)


def _color_starts(sample: Float64[np.ndarray, "N C"], first: int) -> list[int]:
    """Return where three columns from ``first`` on may be colours."""
    columns = range(sample.shape[1])
    kinds = [_kind(sample[:, i]) if i >= first else "" for i in columns]
    varied = [_is_varied(sample[:, i]) for i in columns]
    i = first
    while i <= len(kinds) - 3:
        is_normal = _are_normals(sample[:, i : i + 3])
        kinds[i : i + 3] = ["", "", ""] if is_normal else kinds[i : i + 3]
        i += 3 if is_normal else 1
    starts = _alike([kinds[i] if varied[i] else "" for i in columns])
    if not starts:  # of a scene of few colours, or all are black
        starts = _alike(["" if varied[i] else kinds[i] for i in columns])
        largest = [np.nanmax(sample[:, i : i + 3]) for i in starts]
        starts = [i for i, most in zip(starts, largest, strict=True) if not 1 <= most <= _LABEL]
    if len(starts) == 2 and starts[1] == starts[0] + 1:
        four = sample[:, starts[0] : starts[0] + 4]
        starts = [starts[k] for k in _colors_of_four(four[np.isfinite(four).all(axis=1)])]
    return starts


def _alike(kinds: list[str]) -> list[int]:
    """Return where three columns of one kind start; without any, where bytes are among wide ones.

    Those are a dark channel of 16 bits.
    """
    threes = [set(kinds[i : i + 3]) for i in range(len(kinds) - 2)]
    starts = [i for i, three in enumerate(threes) if any(map(three.issubset, _ALIKE))]
    return starts or [i for i, three in enumerate(threes) if three <= {"wide", "byte"}]


def _kind(column: Float64[np.ndarray, " N"]) -> str:
    """Return the kind of a column as a channel of colours; "" for none."""
    known = column[np.isfinite(column)]
    if not len(known) or known.min() < 0 or known.max() > _WIDE:
        return ""
    if (known == np.rint(known)).all():
        return "bit" if known.max() <= 1 else "byte" if known.max() <= _BYTE else "wide"
    return "unit" if known.max() <= 1 else ""


def _is_varied(column: Float64[np.ndarray, " N"]) -> bool:
    """Whether a column has more values than labels have."""
    return len(np.unique(column)) > min(_FEW, len(column) / _PER_ROW)


def _are_colors(columns: Float64[np.ndarray, "N 3"]) -> bool:
    return all(_kind(column) for column in columns.T) and not _are_normals(columns)


def _are_normals(values: Float64[np.ndarray, "N 3"]) -> bool:
    """Whether most rows are of length 1, and not all of them whole numbers."""
    known = values[np.isfinite(values).all(axis=1)]
    if not len(known):
        return False
    is_unit = np.abs(np.linalg.norm(known, axis=1) - 1.0) <= _UNIT
    return bool((known != np.rint(known)).any() and is_unit.mean() >= 0.5)


def _colors_of_four(four: Float64[np.ndarray, "N 4"]) -> list[int]:
    """Return which of the first and the last three of four columns may be colours: 0, 1."""
    if len(four) < _MIN_ROWS:
        return [0, 1]
    white = 1.0 if four.max() <= 1 else float(_BYTE if four.max() <= _BYTE else _WIDE)
    four = four / white
    greys = [bool(np.ptp(four[:, k : k + 3], axis=1).max() <= _ROUNDED) for k in (0, 1)]
    averages = [_is_average(four[:, k], four[:, 1:3], four[:, 3 - k]) for k in (0, 3)]
    if any(greys):
        return [greys.index(True)]  # all four are equal if both are
    if any(averages):
        return [0, 1] if all(averages) else [averages[::-1].index(True)]
    return _lasers(four) if four.std(axis=0).all() else [0, 1]


def _lasers(four: Float64[np.ndarray, "N 4"]) -> list[int]:
    """As ``_colors_of_four``, for intensity that is not made from the colours."""
    related = np.corrcoef(four.T)
    outer = related[0, 1:3], related[3, 1:3]
    if abs(_partial(related, 0, 3, [1, 2])) <= _PARTIAL and related[1, 2] >= _FOLLOWS:
        for k, (channel, other) in enumerate((outer, outer[::-1])):
            if channel.min() >= _FOLLOWS and np.abs(other).max() <= _INDEPENDENT:
                return [k]
    return [0, 1]


def _is_average(
    values: Float64[np.ndarray, " N"],
    inner: Float64[np.ndarray, "N 2"],
    outer: Float64[np.ndarray, " N"],
) -> bool:
    """Whether values are a rising linear function of three channels, not of two of them."""
    one = np.ones((len(values), 1))
    two = np.concatenate([one, -one, inner], axis=1)
    error, without = (
        nnls(columns, values)[1] / np.sqrt(len(values))
        for columns in (np.column_stack([two, outer]), two)
    )
    return bool(error <= _ROUNDED and 2 * error <= min(without, values.std()))


def _partial(related: Float64[np.ndarray, "4 4"], i: int, j: int, given: list[int]) -> float:
    """Return the correlation of two columns beyond what others explain."""
    inverse = np.linalg.pinv(related[np.ix_([i, j, *given], [i, j, *given])])
    scale = np.sqrt(abs(inverse[0, 0] * inverse[1, 1]))
    return float(-inverse[0, 1] / scale) if scale > 0 else 0.0
