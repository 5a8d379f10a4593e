"""Findings: what readers, checks and methods report about a user's data, as data.

A ``Finding`` has a stable ``kind`` to filter by, in kebab case; its text may be reworded at any
time, so that no code compares it. ``docs/findings.md`` lists the kinds. Texts follow the rules of
messages in ``errors``: an argument stands in backticks.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

Severity = Literal["info", "warning", "error"]
"""``info``: what was done or chosen; ``warning``: data was repaired, left out, or looks wrong;
``error``: what the user asked for cannot give a right result."""

LEVELS = {"info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}
"""The level of ``logging`` for each severity."""
LOGGER = logging.getLogger("splatseed")
"""The parent of all loggers of splatseed."""


@dataclass(frozen=True)
class Finding:
    """One thing that was found out about a scene, a file or a run.

    Example:
        >>> print(Finding("duplicate-points", "3 points repeat a position.", fix="Remove them."))
        3 points repeat a position. Remove them.
    """

    kind: str  # kebab case; stable between versions
    text: str  # sentences for the user
    severity: Severity = "warning"
    subjects: tuple[str, ...] = ()  # names of the images or files that it is about
    fix: str = ""  # what the user can do, as a sentence

    def __post_init__(self) -> None:
        assert self.severity in get_args(Severity)  # noqa: S101  (our own invariant)

    def __str__(self) -> str:
        """Return the text and how to mend it."""
        return f"{self.text} {self.fix}".strip()


def without_kinds(findings: Iterable[Finding], *kinds: str) -> tuple[Finding, ...]:
    """Return the findings of other kinds."""
    return tuple(each for each in findings if each.kind not in kinds)
