"""A budget in words."""

from __future__ import annotations

import pytest

from splatseed.errors import ParameterError
from splatseed.seeding.amounts import parse_budget


@pytest.mark.parametrize(
    ("budget", "number"),
    [
        ("50000", 50_000),
        (" 5e4", 50_000),
        (50_000, 50_000),
        ("50k", 50_000),
        ("0.5M", 500_000),
        ("0.25rho", 500),
        ("1 RHO", 2000),
        (2.6, 3),
    ],
)
def test_a_budget_is_a_number_or_a_density(budget, number):
    assert parse_budget(budget, 2000) == number


@pytest.mark.parametrize(("typed", "meant"), [("0,25rho", r"0\.25rho"), ("0.25", r"0\.25rho")])
def test_what_was_meant_is_told(typed, meant):
    with pytest.raises(ParameterError, match=rf"Did you mean {meant}\?"):
        parse_budget(typed, 2000)


def test_a_slip_of_many_digits_is_told():
    with pytest.raises(ParameterError, match="a budget that a trainer can hold; found '1e30'"):
        parse_budget("1e30", 2000)


@pytest.mark.parametrize("budget", ["", "many", "rho", "-3", "0", "0.1", "nan", "inf", "1e-9rho"])
def test_no_other_budget_is_taken(budget):
    with pytest.raises(ParameterError, match="expected a budget such as 50000"):
        parse_budget(budget, 2000)


@pytest.mark.parametrize("budget", ["0.25", 0.75])
def test_a_fraction_alone_may_have_been_meant_as_a_density(budget):
    with pytest.raises(ParameterError, match=rf"Did you mean {budget}rho\?"):
        parse_budget(budget, 2000)
