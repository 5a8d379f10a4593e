"""A hook of mkdocs: the site has no links to files outside of docs, such as benchmarks and code."""
# ruff: noqa: INP001  (a script, not a package)

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import Any

ROOT = Path(__file__).parents[1]
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)\s:#]+)(#[^)\s]*)?\)")
"""Text, path and anchor of a link to a file."""


def on_page_markdown(markdown: str, *, page: Any, **_: object) -> str:
    """Replace links to files outside of docs by their text."""
    folder = (ROOT / "docs" / PurePosixPath(page.file.src_uri)).parent

    def kept(link: re.Match[str]) -> str:
        inside = (folder / link[2]).resolve().is_relative_to(ROOT / "docs")
        return link[0] if inside else link[1]

    return LINK.sub(kept, markdown)
