"""Findings are data: kinds are documented, and no code compares texts."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import splatseed
from splatseed.findings import Finding, without_kinds

SOURCE = Path(splatseed.__file__).parent
PAGE = Path(__file__).parents[1] / "docs" / "findings.md"
FILES = sorted(SOURCE.rglob("*.py"))
TEXTS = {"text", "fix"}
COMPARED_BY = {"startswith", "endswith", "find", "index", "count", "partition", "split", "replace"}


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(ast.parse(path.read_text("utf-8"))))


def kinds_of(path: Path) -> Iterator[str]:
    """The kinds that a file names: literals, and constants of modules."""
    constants = {
        target.id: node.value.value
        for node in nodes(path)
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    for node in nodes(path):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            if node.func.id != "Finding":
                continue
            kind = node.args[0] if node.args else None
            if isinstance(kind, ast.Constant):
                yield kind.value
            elif isinstance(kind, ast.Name) and kind.id in constants:
                yield constants[kind.id]


def is_text(node: ast.AST) -> bool:
    """Whether an expression is the text of a finding."""
    if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "str":
        return any(getattr(each, "id", "") in {"finding", "each"} for each in node.args)
    return isinstance(node, ast.Attribute) and node.attr in TEXTS


def test_every_kind_is_documented_and_every_documented_kind_exists():
    named = {kind for path in FILES for kind in kinds_of(path)}
    documented = set(re.findall(r"^\| `([a-z0-9-]+)` \|", PAGE.read_text("utf-8"), re.MULTILINE))
    assert len(named) > 100
    assert named - documented == set()
    strings = {n.value for p in FILES for n in nodes(p) if isinstance(n, ast.Constant)}
    assert documented - strings == set()
    assert all(re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", kind) for kind in named)


def test_no_code_compares_texts():
    compared = []
    for path in FILES:
        for node in nodes(path):
            if isinstance(node, ast.Compare):
                parts = [node.left, *node.comparators]
            elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") in COMPARED_BY:
                parts = [node.func.value]
            else:
                continue
            if any(map(is_text, parts)):
                compared.append(f"{path.name}:{node.lineno}: {ast.unparse(node)}")
    assert compared == []


def test_findings_are_filtered_by_kind():
    findings = [Finding("a", "A."), Finding("b", "B.", fix="Mend it.")]
    assert [str(each) for each in without_kinds(findings, "a")] == ["B. Mend it."]
