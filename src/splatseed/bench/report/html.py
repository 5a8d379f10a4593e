"""The report's page: one self-contained file, for desktop or phone, light or dark.

Promise: every text is escaped; the page may load nothing (its own policy forbids it), runs one
script of a few lines, and shows everything without it.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.resources import files
from string import Template

from splatseed.bench.analysis.tables import Cell, Table, cell_text

PNG, JPEG = "image/png", "image/jpeg"
_WORDS = ' class="words"'


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Args:
        key: The anchor that links point to.
        title: Its heading.
        blocks: HTML, in order; a section without blocks is left out.
    """

    key: str
    title: str
    blocks: Sequence[str]


def page(title: str, subtitle: str, sections: Iterable[Section]) -> str:
    """The whole page.

    Args:
        title: The heading.
        subtitle: A line below.
        sections: Its parts.
    """
    shown = [section for section in sections if section.blocks]
    links = "".join(f'<a href="#{escape(s.key)}">{escape(s.title)}</a>' for s in shown)
    body = "".join(
        f'<section id="{escape(s.key)}"><h2>{escape(s.title)}</h2>{"".join(s.blocks)}</section>'
        for s in shown
    )
    return Template(_resource("report.html")).substitute(
        title=escape(title),
        subtitle=escape(subtitle),
        links=links,
        body=body,
        style=_resource("report.css"),
        script=_resource("report.js"),
    )


@cache
def _resource(name: str) -> str:
    return (files("splatseed.bench.report") / "data" / name).read_text("utf-8")


def paragraphs(texts: Iterable[str], kind: str = "") -> str:
    """Paragraphs of plain text.

    Args:
        texts: One each.
        kind: Their class in the style sheet.
    """
    mark = f' class="{escape(kind)}"' if kind else ""
    return "".join(f"<p{mark}>{escape(text)}</p>" for text in texts)


def answer(sentences: Sequence[str]) -> str:
    """The sentences of an answer, the first of them the answer itself."""
    return (
        f'<div class="answer">{paragraphs(sentences[:1], "lead")}{paragraphs(sentences[1:])}</div>'
    )


def preformatted(text: str) -> str:
    """Text as it is, such as a command, that scrolls where it is wide."""
    return f'<pre tabindex="0">{escape(text)}</pre>'


def table(content: Table) -> str:
    """A table that scrolls sideways where it is wide, with its notes folded below."""
    if not content.rows:
        return _captioned(content, paragraphs(["None.", *content.notes[:1]]))
    texts = [_is_text(column) for column in zip(*content.rows, strict=True)]
    head = "".join(
        f'<th scope="col"{_WORDS if texts[i] else ""}>{escape(name)}</th>'
        for i, name in enumerate(content.header)
    )
    rows = "".join(f"<tr>{''.join(map(_cell, row, range(len(row))))}</tr>" for row in content.rows)
    inner = f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
    return _captioned(content, f'<div class="scroll" tabindex="0">{inner}</div>')


def _captioned(content: Table, inner: str) -> str:
    notes = paragraphs(content.notes)
    folded = f"<details><summary>How to read this</summary>{notes}</details>" if notes else ""
    title = f"<h3>{escape(content.title)}</h3>"
    return f'<div class="table" id="table-{escape(content.name)}">{title}{inner}{folded}</div>'


def _is_text(column: Sequence[Cell]) -> bool:
    return all(cell.value is None for cell in column) and any(cell.text for cell in column)


def _cell(cell: Cell, place: int) -> str:
    text = escape(cell_text(cell))
    if cell.bold and text:
        text = f"<strong>{text}</strong>"
    if cell.mark:
        text += f' <span class="mark">{escape(cell.mark)}</span>'
    kinds = ["soft"] if cell.soft else []
    if cell.value is None and cell.text:
        kinds.append("words")
    kind = f' class="{" ".join(kinds)}"' if kinds else ""
    return f'<th scope="row"{kind}>{text}</th>' if place == 0 else f"<td{kind}>{text}</td>"


def figure(content: bytes, caption: str, *, kind: str = PNG) -> str:
    """A picture with its caption, that scrolls where it is wider than the page."""
    image = f'<img src="{data_uri(content, kind)}" alt="{escape(caption)}">'
    return (
        f'<figure><div class="scroll paper" tabindex="0">{image}</div>'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def data_uri(content: bytes, kind: str) -> str:
    """A file's bytes within an address."""
    return f"data:{kind};base64,{b64encode(content).decode('ascii')}"


def folded(title: str, blocks: Sequence[str], *, is_open: bool) -> str:
    """Blocks under a title that opens and closes.

    Args:
        title: The title.
        blocks: HTML; nothing is made of none.
        is_open: Whether they are shown at first.
    """
    if not blocks:
        return ""
    mark = " open" if is_open else ""
    summary = f"<summary>{escape(title)}</summary>"
    return f'<details class="fold"{mark}>{summary}{"".join(blocks)}</details>'


def slider(title: str, pictures: Mapping[str, bytes], shape: float) -> str:
    """Pictures of one size stacked on each other, with a slider between any two of them.

    Args:
        title: What they are of.
        shape: Their width over their height, for them to fit the window.
        pictures: JPEG by name, at least two; the first two are compared at first.
    """
    images = "".join(
        f'<img src="{data_uri(content, JPEG)}" alt="{escape(f"{name}, {title}")}">'
        for name, content in pictures.items()
    )
    choices = "".join(f"<option>{escape(name)}</option>" for name in pictures)
    return (
        f'<figure class="compare" style="--shape: {shape:.4f}">'
        f"<figcaption>{escape(title)}</figcaption>"
        f'<div class="stage">{images}</div>'
        '<input type="range" min="0" max="100" value="50" aria-label="where the two meet">'
        f'<div class="choices"><label>left <select data-side="left">{choices}</select></label>'
        f'<label>right <select data-side="right">{choices}</select></label></div></figure>'
    )
