"""The report's part on the ledger: failed and missing runs, command, machine and plan."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from splatseed.bench.analysis.study import Study
from splatseed.bench.analysis.tables import Table, words
from splatseed.bench.planning.records import RunRow
from splatseed.bench.report.html import Section, paragraphs, preformatted, table
from splatseed.literal import counted

SHOWN = 200
"""Runs listed in a table; of a large plan that has just begun, nearly all are missing."""


def counts(rows: Sequence[RunRow]) -> str:
    """How many runs there are of each kind.

    Args:
        rows: The ledger's rows.
    """
    told = [counted(len(rows), "run")]
    for status, said in (("done", "done"), ("failed", "failed"), ("running", "running"),
                         ("pending", "to do")):  # fmt: skip
        number = sum(row.status == status for row in rows)
        if number:
            told.append(f"{number:,} {said}")
    return ", ".join(told)


def ledger_sections(
    rows: Sequence[RunRow],
    sessions: Sequence[Mapping[str, Any]],
    plan: str,
    studies: Sequence[Study] = (),
) -> tuple[Section, ...]:
    """The sections on runs and on how they were made.

    Args:
        rows: The ledger's rows.
        sessions: What the ledger knows of calls of the command.
        plan: The plan as text; empty where it is gone.
        studies: The studies, for runs whose scores are set aside.
    """
    return (
        Section("runs", "Runs", [paragraphs([f"{counts(rows)}."]), *_run_tables(rows, studies)]),
        Section("setup", "How it was run", [*_setup(rows, sessions), *_plan(plan)]),
    )


def _run_tables(rows: Sequence[RunRow], studies: Sequence[Study]) -> Iterable[str]:
    failed = [row for row in rows if row.status == "failed"]
    missing = [row for row in rows if row.status in {"pending", "running"}]
    odd = [name for study in studies for name in study.not_finite]
    if failed:
        yield table(_run_table("failed", "Failed runs", failed, "error"))
    if missing:
        yield table(_run_table("missing", "Runs still missing", missing, "status"))
    if odd:
        yield paragraphs(
            [f"PSNR is not finite, so that these runs are in no mean: {'; '.join(odd)}."]
        )


def _run_table(name: str, title: str, rows: Sequence[RunRow], last: str) -> Table:
    listed = tuple(
        (
            words(row.spec.scene),
            words(row.spec.arm.label),
            words(row.spec.arm.strategy),
            words(f"{row.spec.repeat}"),
            words(f"{row.attempts}"),
            words(str(getattr(row, last))),
        )
        for row in rows[:SHOWN]
    )
    more = f"And {len(rows) - SHOWN:,} more." if len(rows) > SHOWN else ""
    header = ("scene", "method", "strategy", "repeat", "begun", last)
    return Table(name, f"{title}: {len(rows):,}", header, listed, (more,) if more else ())


def _setup(rows: Sequence[RunRow], sessions: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    commands = dict.fromkeys(str(each["command"]) for each in sessions if "command" in each)
    if commands:
        yield paragraphs(["The commands, in order:" if len(commands) > 1 else "The command:"])
        yield preformatted("\n".join(commands))
    devices = dict.fromkeys(row.result.device for row in rows if row.result is not None)
    facts = [("trained on", ", ".join(devices))] if devices else []
    if sessions:
        facts += _facts(sessions[-1])
    if facts:
        rows_of_facts = tuple((words(name), words(value)) for name, value in facts)
        calls = f"Calls of the command: {len(sessions)}; the last is described." if sessions else ""
        yield table(
            Table(
                "environment",
                "Environment",
                ("what", "found"),
                rows_of_facts,
                (calls,) if calls else (),
            )
        )


def _facts(session: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What is recorded of a call, as names and texts."""
    told = []
    for name, value in session.items():
        if name == "started" and isinstance(value, float | int):
            moment = datetime.fromtimestamp(value, tz=UTC)
            told.append(("started", moment.strftime("%Y-%m-%d %H:%M UTC")))
        elif name == "memory_bytes" and isinstance(value, int):
            told.append(("memory", f"{value / 1e9:.1f} GB"))
        elif isinstance(value, Mapping):
            told.append((name, ", ".join(f"{key} {each}" for key, each in value.items())))
        elif name != "command" and value not in (None, ""):
            told.append((name, str(value)))
    return told


def _plan(plan: str) -> Iterable[str]:
    if plan:
        yield paragraphs(
            ["The plan; save it as plan.toml and run splatseed bench --plan plan.toml:"]
        )
        yield preformatted(plan)
