"""Fonts for names in any script: matplotlib's own has no Chinese, Japanese or Korean."""

from __future__ import annotations

from functools import lru_cache

_WIDE = (
    "Noto Sans CJK JP",
    "Noto Sans CJK SC",
    "Noto Sans JP",
    "Noto Sans SC",
    "Source Han Sans",
    "WenQuanYi Zen Hei",
    "WenQuanYi Micro Hei",
    "IPAexGothic",
    "Droid Sans Fallback",
    "Yu Gothic",
    "MS Gothic",
    "Microsoft YaHei",
    "Malgun Gothic",
    "Hiragino Sans",
    "PingFang SC",
    "Apple SD Gothic Neo",
    "Arial Unicode MS",
)
"""Families with these scripts; most systems have one."""


@lru_cache(maxsize=1)
def font_families() -> tuple[str, ...]:
    """Families for text in figures, in order of preference."""
    from matplotlib.font_manager import fontManager  # noqa: PLC0415  (slow to import)

    there = {each.name for each in fontManager.ttflist}
    return ("DejaVu Sans", *(name for name in _WIDE if name in there))


def plain(text: str) -> str:
    r"""A name as text for matplotlib: a dollar would begin a formula.

    Characters that no font contains become \u....

    Example:
        >>> plain("a$b")
        'a\\$b'
    """
    known = _known_characters()
    shown = (
        each if ord(each) in known else each.encode("unicode_escape").decode() for each in text
    )
    return "".join(shown).replace("$", r"\$")


@lru_cache(maxsize=1)
def _known_characters() -> frozenset[int]:
    """The characters that a figure can show."""
    from matplotlib.font_manager import FontProperties, findfont, get_font  # noqa: PLC0415  (loads with its use)

    paths = {findfont(FontProperties(family=[name])) for name in font_families()}
    return frozenset(code for path in paths for code in get_font(path).get_charmap())


def font_file(text: str) -> str | None:
    """A font file with all of a text's characters; None if there is none."""
    from matplotlib.font_manager import FontProperties, findfont, get_font  # noqa: PLC0415  (loads with its use)

    for name in font_families():
        path = findfont(FontProperties(family=[name]))
        if set(map(ord, text)) <= get_font(path).get_charmap().keys():
            return str(path)
    return None
