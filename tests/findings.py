"""What a user reads of what was found out."""

from __future__ import annotations

from typing import Protocol

from splatseed.findings import Finding


class Reported(Protocol):
    """A scene, a report or a file with its findings."""

    findings: tuple[Finding, ...]


def texts(reported: Reported) -> tuple[str, ...]:
    """The sentences that the command line prints."""
    return tuple(map(str, reported.findings))
