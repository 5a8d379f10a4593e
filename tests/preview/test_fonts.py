"""Names in any script in figures: shown where a font has them, escaped where none has, never a
formula."""

from __future__ import annotations

import warnings
from io import BytesIO

import numpy as np
import pytest
from matplotlib.figure import Figure

from splatseed.preview import fonts
from splatseed.preview.page import Tile, write_grid

NAMES = [
    "日本語の部屋",
    "방 $a_1$",
    r"\frac $",
    "Ελλάδα",
    "plain_name",
    "a$b$",
    "x^2",
    "\U0001f3e0",
]


@pytest.mark.parametrize("name", NAMES)
def test_a_figure_can_be_drawn_without_a_warning(name):
    figure = Figure()
    axes = figure.subplots()
    with warnings.catch_warnings(action="error"):
        axes.set_title(fonts.plain(name), family=fonts.font_families())
        axes.set_yticks([0], [fonts.plain(name)], family=fonts.font_families())
        figure.savefig(BytesIO())


@pytest.mark.parametrize("name", NAMES)
def test_a_page_can_be_drawn(name, tmp_path):
    write_grid([Tile(name, np.zeros((50, 300, 3), np.uint8))], tmp_path / "a.png", columns=1)


def test_what_fonts_have_is_shown_as_it_is(monkeypatch):
    assert fonts.plain("Ελλάδα é") == "Ελλάδα é"
    assert fonts.plain("a$b") == r"a\$b"
    monkeypatch.setattr(fonts, "_known_characters", lambda: frozenset(map(ord, "ab")))
    assert fonts.plain("aé") == r"a\xe9"
    monkeypatch.setattr(fonts, "_known_characters", lambda: frozenset(map(ord, "日本")))
    assert fonts.plain("日本") == "日本"


def test_the_first_family_that_has_all_is_taken():
    assert fonts.font_families()[0] == "DejaVu Sans"
    assert "DejaVuSans" in fonts.font_file("Ελλάδα")
    assert fonts.font_file("\U000f0000") is None
