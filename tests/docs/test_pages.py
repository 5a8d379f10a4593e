"""What the pages say holds: commands, options and links; and so do the docstrings' examples."""

from __future__ import annotations

import doctest
import re
import runpy
import shlex
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest

from splatseed.cli import COMPLETION, VERBS
from splatseed.commands.bench import ReportOptions, parse_plan
from splatseed.commands.options import parse_options
from splatseed.commands.upsample import full_options
from splatseed.errors import SceneNotFoundError

from ..command_line import options_of
from ..test_package import module_paths

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
MEASURED = sorted((ROOT / "benchmarks").rglob("*.md"))
LINKED = dict.fromkeys([*PAGES, *ROOT.glob("*.md"), *MEASURED])
OWN_METHOD = "jitter"
"""Of an example, which has to be installed or written first."""
OTHERS = {"--max-2D-matches-per-3D-point"}
"""Options of other programs that our pages name."""


def _kinds(verb):
    """The options of a verb, and of ``bench report``."""
    if verb == "upsample":
        return [full_options()]
    kind = import_module(f"splatseed.commands.{verb}").Options
    return [kind, ReportOptions] if verb == "bench" else [kind]


def _blocks(page):
    return re.findall(r"```sh\n(.*?)```", page.read_text("utf-8"), re.DOTALL)


def _commands():
    """The words of each whole command in a page's blocks, after ``splatseed``."""
    found = dict[tuple[str, ...], str]()  # once, though several pages have it
    for page in (*PAGES, *MEASURED):
        for line in "".join(_blocks(page)).replace("\\\n", " ").splitlines():
            words = shlex.split(line.partition(">")[0], comments=True)
            own = any(OWN_METHOD in word for word in words)
            if words and Path(words[0]).name == "splatseed" and not own:
                found.setdefault(tuple(words[1:]), page.name)
    for words, name in found.items():
        yield pytest.param(list(words), id=f"{name}: {' '.join(words)}")


@pytest.mark.parametrize("words", list(_commands()))
def test_whole_commands_are_understood(words, tmp_path, monkeypatch):
    """Their files need not be there."""
    monkeypatch.chdir(tmp_path)
    verb, *rest = words
    assert verb in {*VERBS, COMPLETION}
    if "--help" in rest or verb == COMPLETION:
        return
    if verb == "bench" and rest[0] == "report":
        parse_options(ReportOptions, verb, rest[1:])
    elif verb == "bench":
        with suppress(SceneNotFoundError):  # a plan that the reader has
            parse_plan(rest)
    elif verb == "train" and "--config" in rest:
        parse_options(_kinds(verb)[0], verb, ["SCENE", "-o", "RUN", *rest])
    else:
        parse_options(_kinds(verb)[0], verb, rest)


@cache
def _options(verb):
    return {option for kind in _kinds(verb) for option in options_of(kind)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_options_in_the_text_are_there(page):
    for code in re.findall(r"`([^`]+)`", _without_blocks(page)):
        named = re.match(r"\s*splatseed\s+([a-z]+)\b", code)
        if named:
            assert named[1] in VERBS, code
        elif not code.startswith("--"):
            continue  # another program's
        known = [_options(verb) for verb in ([named[1]] if named else VERBS)]
        for option in re.findall(r"(?<![\w-])--[a-z][\w.-]*", code):
            everywhere = OTHERS | {"--help", "--version", COMPLETION}
            assert any(option in each for each in known) or option in everywhere, code


def _without_blocks(page):
    return re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.DOTALL)


def _anchors(page):
    """As GitHub makes them of headings, a repeated one with a number; and those set by hand."""
    text = _without_blocks(page)
    anchors = re.findall(r'<a id="(.*?)">', text)
    for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE):
        anchor = re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        again = sum(
            re.fullmatch(rf"{re.escape(anchor)}(-\d+)?", each) is not None for each in anchors
        )
        anchors.append(f"{anchor}-{again}" if again else anchor)
    return anchors


@pytest.mark.parametrize("page", LINKED, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    text = re.sub(r"`[^`]*`", "", _without_blocks(page))
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue  # elsewhere
        path, _, anchor = target.partition("#")
        other = (page.parent / path).resolve() if path else page
        assert other.exists(), target
        assert not anchor or anchor in _anchors(other), target


EXAMPLES = [name for name, path in module_paths().items() if ">>> " in path.read_text("utf-8")]
"""The modules whose text has any; tests/test_package.py imports the others."""


@pytest.mark.parametrize("name", EXAMPLES)
def test_docstrings_examples_give_what_they_say(name):
    result = doctest.testmod(import_module(name), optionflags=doctest.ELLIPSIS)
    assert result.attempted
    assert result.failed == 0


def test_the_site_keeps_links_among_its_pages_and_no_others():
    """As does mkdocs, which need not be installed."""
    change = runpy.run_path(str(ROOT / "docs" / "site_links.py"))["on_page_markdown"]
    page = SimpleNamespace(file=SimpleNamespace(src_uri="results/gpu.md"))
    inside = "[a](../training.md#cpu-or-cuda), [b\nc](README.md), [d](https://d.e), [f](#g)"
    outside = " ![h](../pictures/h.png) [i](../../benchmarks/README.md#j) [k](../../examples)"
    assert change(inside + outside, page=page) == f"{inside} ![h](../pictures/h.png) i k"
