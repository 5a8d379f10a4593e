"""Numbers in sentences, with nouns and verbs that agree with them."""

from __future__ import annotations

__all__ = ["agreeing", "counted"]


def counted(number: int, noun: str) -> str:
    """A number and what it counts.

    Args:
        number: How many there are.
        noun: One of them, in a word whose plural ends in s.

    Example:
        >>> print(counted(1, "test view"), counted(2300, "point"), sep=", ")
        1 test view, 2,300 points
    """
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def agreeing(number: int, one: str, more: str) -> str:
    """The verb that agrees with a number of things.

    Example:
        >>> agreeing(1, "is", "are")
        'is'
    """
    return one if number == 1 else more
