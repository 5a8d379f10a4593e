"""The background of renders, over which transparent pixels of photographs are composited.

A model's scores are those of the background that it was trained on: over another one, Gaussians
that vanished before it show, and empty space has the wrong colour. splatseed trains on black. Other
trainers record theirs beside the model: graphdeco's and its relatives ``white_background`` in
``cfg_args``, nerfstudio ``background_color`` of the model and ``alpha_color`` of the photographs in
``config.yml``, forks of gsplat's trainer ``white_background`` in ``cfg.yml``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from splatseed.errors import ParameterError, SplatseedError
from splatseed.findings import Finding
from splatseed.io.files import read_text
from splatseed.progress import Note, silent_note
from splatseed.scene import BLACK, Color

WHITE: Color = (255, 255, 255)
_NAMES: dict[str, Color] = {"black": BLACK, "white": WHITE}
_WHITE_OR_NOT = r"\bwhite_(?:background|bkgd|bg)[=:] *(true|false)\b"
_RECORDS = {
    "cfg_args": (_WHITE_OR_NOT,),
    "cfg.yml": (_WHITE_OR_NOT,),
    "config.yml": (r"^ *alpha_color: *(black|white)\b", r"^ *background_color: *(black|white)\b"),
}
"""Files of trainers, and what names the background in them; the first that matches decides."""
_COLORS = {**_NAMES, "true": WHITE, "false": BLACK}


class Background(NamedTuple):
    """A background, and the file that records it."""

    color: Color
    file: Path


def parse_background(text: str) -> Color:
    """Parse ``black``, ``white``, or red, green and blue from 0 to 255.

    Example:
        >>> parse_background("white"), parse_background("38,42,55")
        ((255, 255, 255), (38, 42, 55))
    """
    parts = [part.strip() for part in text.split(",")]
    if text in _NAMES:
        return _NAMES[text]
    if len(parts) != 3 or not all(re.fullmatch("[0-9]{1,3}", p) and int(p) <= 255 for p in parts):
        raise ParameterError(
            "`background` to be black, white, or red, green and blue from 0 to 255",
            found=repr(text),
            fix="Try `background='white'`.",
        )
    red, green, blue = map(int, parts)
    return red, green, blue


def name_background(color: Color) -> str:
    """Return the name of a background, or its red, green and blue."""
    return next((name for name, each in _NAMES.items() if each == color), ",".join(map(str, color)))


def recorded_background(model: Path) -> Background | None:
    """Find the background that a trainer recorded in the model's folder or up to three above.

    None if there is no record, or the background was random, so that any is right.
    """
    found = recorded(model, _RECORDS)
    return None if found is None else Background(_COLORS[found[0].lower()], found[1])


def recorded(model: Path, patterns: Mapping[str, Sequence[str]]) -> tuple[str, Path] | None:
    """Find what a trainer recorded in the model's folder or up to three above.

    Args:
        model: The file of the model.
        patterns: Expressions with one group, by the name of the file; the first match decides.

    Returns:
        The group, and the file.
    """
    for folder in model.resolve().parents[:4]:
        for name, expressions in patterns.items():
            content = ""
            with suppress(OSError, SplatseedError, UnicodeDecodeError):
                content = read_text(folder / name)
            for expression in expressions:
                if found := re.search(expression, content, re.IGNORECASE | re.MULTILINE):
                    return found[1], folder / name
    return None


def background_of(
    model: Path | None, choice: str | None = None, note: Note = silent_note
) -> Color | None:
    """Return the background that is chosen, else that of the model's record; None if unknown.

    ``note`` is called with a record of another background than splatseed's.
    """
    if choice is not None:
        return parse_background(choice)
    found = None if model is None else recorded_background(model)
    if found is None:
        return None
    if found.color != BLACK:
        name = name_background(found.color)
        text = f"The background of renders and of transparent pixels is {name}, as {found.file} "
        note(Finding("background", f"{text}says.", "info", subjects=(str(model),)))
    return found.color
