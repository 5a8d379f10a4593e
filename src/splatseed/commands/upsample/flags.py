"""How the options of ``splatseed upsample`` appear in its help."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tyro


def number_flag(kind: type, default: str) -> Any:
    """How an optional number appears in the help: as a number, with its default in words."""
    return tyro.conf.arg(
        constructor=kind,
        metavar=kind.__name__.upper(),
        help_behavior_hint=f"(default: {default})",
    )


def cover_flag() -> Any:
    """The flag --cover; its field has another name, since the method cover has that one."""
    return tyro.conf.arg(
        name="cover",
        constructor=int,
        metavar="INT",
        help_behavior_hint="(default: none; auto and cover have --auto.cell and --cover.cell)",
    )


def budget_flag() -> Any:
    """How a budget appears in the help."""
    return tyro.conf.arg(
        constructor=str, metavar="N|Xrho", help_behavior_hint="(default: no limit)"
    )


def memory_flag() -> Any:
    """How an amount of memory appears in the help."""
    return tyro.conf.arg(
        constructor=str,
        metavar="BYTES|4G",
        help_behavior_hint="(default: what is free; --cloud: at most 4G)",
    )


def default_flag(stands_in: str, metavar: str) -> Any:
    """How an optional choice appears in the help: without None, with its default in words."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {stands_in})")


def output_flag() -> Any:
    """The flag --output; a scene alone is a question for advice."""
    return tyro.conf.arg(
        aliases=["-o"],
        help_behavior_hint="(without it: a recommendation for --budget and --max-steps, nothing is "
        "written)",
    )


def depth_folder_flag() -> Any:
    """The flag --depth; its field has another name, since the method depth has that one."""
    return tyro.conf.arg(
        name="depth", constructor=Path, metavar="DIR", help_behavior_hint="(default: the scene's)"
    )
