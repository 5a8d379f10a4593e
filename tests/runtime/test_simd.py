"""Every operation on sixteen lanes against NumPy's float32."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from splatseed.runtime import simd
from splatseed.runtime.simd import LANES

SPECIAL = np.array(
    [0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, 1e-40, -1e-40, 3e38, 1e-38, 7.5, 7.5, -2, 5, 3],
    np.float32,
)


@pytest.fixture
def lanes(rng: np.random.Generator):
    """Pairs and triples of arrays worth trying: plain numbers and everything special."""
    plain = rng.normal(size=(3, LANES)).astype(np.float32)
    return [tuple(plain), (SPECIAL, SPECIAL[::-1].copy(), np.roll(SPECIAL, 5))]


def applied(function, *arrays: np.ndarray) -> np.ndarray:
    """A function of vectors, on arrays of sixteen."""
    out = np.full(LANES, -77.0, np.float32)
    function(*arrays, out)
    return out


def of_two(operation):
    """An operation on the lanes of two arrays, compiled."""

    @njit
    def run(a, b, out):
        simd.store(out, 0, operation(simd.load(a, 0), simd.load(b, 0)))

    return run


def of_three(operation):
    """An operation on the lanes of three arrays, compiled."""

    @njit
    def run(a, b, c, out):
        simd.store(out, 0, operation(simd.load(a, 0), simd.load(b, 0), simd.load(c, 0)))

    return run


@njit
def _select(a, b, out):
    a, b = simd.load(a, 0), simd.load(b, 0)
    yes, no = simd.broadcast(np.float32(1.0)), simd.broadcast(np.float32(2.0))
    simd.store(out, 0, simd.select_greater(a, b, yes, no))


@njit
def _any_greater(a, b):
    return simd.any_greater(simd.load(a, 0), simd.load(b, 0))


@njit
def _lane_sum(a):
    return simd.lane_sum(simd.load(a, 0))


@njit
def _load_columns(a, start, out):
    for j, vector in enumerate(simd.load_columns(a, start)):
        simd.store(out, LANES * j, vector)


@njit
def _store_transposed(a, out, start):
    rows = (
        simd.load(a, 0), simd.load(a, 16), simd.load(a, 32), simd.load(a, 48),
        simd.load(a, 64), simd.load(a, 80), simd.load(a, 96), simd.load(a, 112),
        simd.load(a, 128), simd.load(a, 144), simd.load(a, 160), simd.load(a, 176),
        simd.load(a, 192), simd.load(a, 208), simd.load(a, 224), simd.load(a, 240),
    )  # fmt: skip
    simd.store_transposed(out, start, rows)


@njit
def _broadcast_element(a, index, out):
    simd.store(out, 0, simd.broadcast_element(a, index))


@njit
def _element(a, index):
    return simd.element(a, index)


@njit
def _aligned(size):
    return simd.aligned(size)


@njit
def _exp(a, out):
    for start in range(0, len(a), LANES):
        simd.store(out, start, simd.exp_of_eighth(simd.load(a, start)))


@njit
def _negative_magnitude(a, out):
    simd.store(out, 0, simd.negative_magnitude(simd.load(a, 0)))


@njit
def _copy(a, start, out, to):
    simd.store(out, to, simd.load(a, start))


@njit
def _broadcast(x, out):
    simd.store(out, 0, simd.broadcast(x))


@pytest.mark.parametrize(
    ("ours", "numpys"),
    [(simd.add, np.add), (simd.subtract, np.subtract), (simd.multiply, np.multiply),
     (simd.divide, np.divide), (simd.minimum, np.fmin)],
)  # fmt: skip
def test_arithmetic_is_float32s(lanes, ours, numpys) -> None:
    for a, b, _ in lanes:
        with np.errstate(all="ignore"):
            np.testing.assert_array_equal(applied(of_two(ours), a, b), numpys(a, b))


def test_fma_rounds_once(lanes) -> None:
    """Float64 holds the product of two float32 exactly, so one rounding is the float64 one."""
    a, b, _ = lanes[0]
    c = -(a * b)  # what is left is the rounding error of the product, all of which fma keeps
    exact = a.astype(np.float64) * b + c
    assert exact.any()
    np.testing.assert_array_equal(applied(of_three(simd.fma), a, b, c), exact.astype(np.float32))
    np.testing.assert_array_equal(applied(of_three(simd.fnma), a, b, -c), -exact.astype(np.float32))


def test_fma_of_special_numbers(lanes) -> None:
    a, b, c = lanes[1]
    with np.errstate(all="ignore"):
        expected = (a.astype(np.float64) * b + c).astype(np.float32)
    np.testing.assert_array_equal(applied(of_three(simd.fma), a, b, c), expected)


def test_comparisons_are_false_for_nan(lanes) -> None:
    for a, b, _ in lanes:
        np.testing.assert_array_equal(applied(_select, a, b), np.where(a > b, 1, 2))
        assert _any_greater(a, b) == bool((a > b).any())
    nothing, zeros = np.full(LANES, np.nan, np.float32), np.zeros(LANES, np.float32)
    assert not _any_greater(nothing, zeros)
    assert not _any_greater(zeros, nothing)
    assert not _any_greater(zeros, zeros)


@pytest.mark.parametrize("lane", range(LANES))
def test_any_greater_sees_every_lane(lane: int) -> None:
    one = np.zeros(LANES, np.float32)
    one[lane] = 1.0
    assert _any_greater(one, np.zeros(LANES, np.float32))


def folded(values: np.ndarray) -> np.float32:
    """Sum of sixteen float32 as the tree adds them: 8 with 8, 4 with 4, 2 with 2, 1 with 1."""
    while len(values) > 1:
        values = values[: len(values) // 2] + values[len(values) // 2 :]
    return values[0]


def test_lane_sum_adds_in_its_tree(rng) -> None:
    for _ in range(20):
        values = (rng.normal(size=LANES) * 10.0 ** rng.integers(-3, 4, LANES)).astype(np.float32)
        assert _lane_sum(values) == folded(values)


@pytest.mark.parametrize("first", [0, 4, 12])
def test_columns(rng, first: int) -> None:
    square = rng.normal(size=(LANES, LANES)).astype(np.float32)
    padded = np.concatenate([np.full(5, 7.0, np.float32), square.reshape(-1)])
    loaded = np.empty(4 * LANES, np.float32)
    _load_columns(padded, 5 + first, loaded)
    np.testing.assert_array_equal(loaded.reshape(4, LANES), square[:, first : first + 4].T)


def test_transposition(rng) -> None:
    square = rng.normal(size=(LANES, LANES)).astype(np.float32)
    stored = np.zeros(LANES * LANES + 6, np.float32)
    _store_transposed(square.reshape(-1), stored, 3)
    np.testing.assert_array_equal(stored[3:-3].reshape(LANES, LANES), square.T)
    assert not stored[:3].any()
    assert not stored[-3:].any()


def test_single_elements() -> None:
    numbers = np.arange(40, dtype=np.float32)
    out = np.empty(LANES, np.float32)
    _broadcast_element(numbers, 33, out)
    np.testing.assert_array_equal(out, np.full(LANES, 33.0, np.float32))
    assert _element(numbers, 39) == 39.0
    assert _element(numbers.astype(np.int32), 1) == 1


@pytest.mark.parametrize("size", [1, 16, 100])
def test_aligned_arrays(size: int) -> None:
    arrays = [_aligned(size) for _ in range(8)]
    assert all(array.ctypes.data % 64 == 0 and len(array) == size for array in arrays)


def test_exp_is_accurate_where_it_is_used() -> None:
    x = np.linspace(-0.7, 0.0, 16 * 40_000, dtype=np.float32)
    values = np.empty_like(x)
    _exp(x, values)
    exact = np.exp(8.0 * x.astype(np.float64))
    assert np.abs(values / exact - 1.0).max() <= 3e-6
    assert values.max() <= 1.0


def test_exp_never_brings_alpha_past_its_opacity() -> None:
    """At the centre of a Gaussian: within 1e-6 of 1, from below."""
    values = applied(_exp, np.zeros(LANES, np.float32))
    assert ((values <= 1.0) & (values >= 1.0 - 1e-6)).all()


def test_negative_magnitude_is_never_positive(lanes) -> None:
    for a, _, _ in lanes:
        expected = -np.abs(a)
        values = applied(_negative_magnitude, a)
        np.testing.assert_array_equal(values, expected)
        np.testing.assert_array_equal(np.signbit(values), np.signbit(expected))


def test_load_and_store_at_any_offset(rng) -> None:
    source = rng.normal(size=64).astype(np.float32)
    for start, to in ((0, 0), (1, 3), (7, 30), (48, 48)):
        out = np.zeros(64, np.float32)
        _copy(source, start, out, to)
        np.testing.assert_array_equal(out[to : to + LANES], source[start : start + LANES])
        assert np.count_nonzero(out) == LANES


def test_splat() -> None:
    assert (applied(lambda x, out: _broadcast(x[0], out), SPECIAL[11:12]) == 7.5).all()
