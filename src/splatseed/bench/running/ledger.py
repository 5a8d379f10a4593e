"""The ledger: all runs, who has them, and their results, in one SQLite file.

Notation: a *worker* is a process that runs have been handed to; it sends a *heartbeat* every few
seconds while it has any. Promise: a run is handed to one worker at a time, and to another only when
its worker is gone; what is recorded as done stays so; whatever is killed at whatever moment, the
file stays intact. SQLite's rollback journal is used, because its write-ahead log needs memory that
machines on a network file system do not share.
"""

from __future__ import annotations

import json
import os
import sqlite3
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Self

from splatseed.bench.planning.records import RunResult, RunRow, RunSpec
from splatseed.bench.running.worker import is_gone
from splatseed.errors import OutputError, SceneFormatError, SceneNotFoundError

LEDGER = "ledger.sqlite"
"""The ledger's name in the folder of a benchmark."""
APPLICATION_ID = 0x73706C62
"""What SQLite's header says the file is: "splb"."""
SCHEMA = 2
"""Raise this when the tables change, or the fields of a run's specification or result; ledgers of
earlier versions are read, and marked with this when they are written to."""
BUSY_SECONDS = 60.0
"""How long to wait while another process writes."""

TABLES = (
    """CREATE TABLE IF NOT EXISTS runs (
        key TEXT PRIMARY KEY,
        position INTEGER NOT NULL,
        spec TEXT NOT NULL,
        status TEXT NOT NULL DEFAULT 'pending'
            CHECK (status IN ('pending', 'running', 'done', 'failed')),
        result TEXT,
        error TEXT NOT NULL DEFAULT '',
        attempts INTEGER NOT NULL DEFAULT 0,
        worker TEXT NOT NULL DEFAULT '',
        started REAL,
        finished REAL,
        heartbeat REAL,
        CHECK ((status = 'done') = (result IS NOT NULL))
    )""",
    """CREATE TABLE IF NOT EXISTS sessions (
        id INTEGER PRIMARY KEY, started REAL, facts TEXT NOT NULL
    )""",
)


class Ledger:
    """A ledger in a file; each call is one transaction, so it can be used from any thread.

    Args:
        path: The file.
        read_only: Whether writing is left to others.
    """

    def __init__(self, path: Path, *, read_only: bool = False) -> None:
        self.path = path
        self._read_only = read_only

    @classmethod
    def open(cls, path: Path, *, read_only: bool = False) -> Self:
        """The ledger in a file, which is made if it is not there.

        Args:
            path: The file.
            read_only: Whether only to look at it; then it must be there.

        Raises:
            SceneNotFoundError: It is to be looked at and is not there.
            SceneFormatError: The file is not a ledger that this version knows.
            OutputError: It cannot be made.
        """
        if read_only and not path.is_file():
            raise SceneNotFoundError(
                f"a benchmark's ledger at {path}", found="no such file", fix="Name its folder."
            )
        ledger = cls(path, read_only=read_only)
        with ledger._transaction() as db:
            if _is_new(db) and not read_only:
                for statement in TABLES:
                    db.execute(statement)
                db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
                db.execute(f"PRAGMA user_version = {SCHEMA}")
            _check_kind(db, path)
            if not read_only:  # an older splatseed could not read what is written from now on
                db.execute(f"PRAGMA user_version = {SCHEMA}")
        return ledger

    def add(self, specs: Iterable[RunSpec]) -> None:
        """Enter new runs, in the order in which they should be run.

        For known runs, the current paths of their scenes are updated.

        Raises:
            OutputError: The ledger cannot be written.
        """
        with self._transaction() as db:
            (last,) = db.execute("SELECT coalesce(max(position), 0) FROM runs").fetchone()
            db.executemany(
                "INSERT INTO runs (key, position, spec) VALUES (?, ?, ?)"
                " ON CONFLICT (key) DO UPDATE SET spec = excluded.spec",
                [(spec.key, last + i, spec.to_json()) for i, spec in enumerate(specs, start=1)],
            )

    def claim(self, worker: str, among: Collection[str] | None = None) -> RunSpec | None:
        """Hand the next unclaimed run to a worker.

        Runs that were started less often come first, so that one which kills its worker comes last.

        Args:
            worker: Who takes it, as ``worker_name`` says.
            among: Keys to choose from; all when left out.

        Returns:
            The run; None where there is none to take.

        Raises:
            OutputError: The ledger cannot be written.
        """
        with self._transaction() as db:
            now = time.time()
            open_runs = db.execute(
                "SELECT key, spec, status, worker, heartbeat FROM runs"
                " WHERE status IN ('pending', 'running') ORDER BY attempts, position"
            )
            for key, spec, status, owner, heartbeat in open_runs:
                if among is not None and key not in among:
                    continue
                if status == "running" and not is_gone(owner, heartbeat, now):
                    continue
                db.execute(
                    "UPDATE runs SET status = 'running', worker = ?, started = ?, heartbeat = ?,"
                    " finished = NULL, attempts = attempts + 1 WHERE key = ?",
                    (worker, now, now, key),
                )
                return RunSpec.from_json(spec)
        return None

    def heartbeat(self, worker: str) -> None:
        """Record a worker's heartbeat for all of its runs.

        Raises:
            OutputError: The ledger cannot be written.
        """
        with self._transaction() as db:
            db.execute(
                "UPDATE runs SET heartbeat = ? WHERE worker = ? AND status = 'running'",
                (time.time(), worker),
            )

    def finish(self, key: str, result: RunResult) -> bool:
        """Record the result of a run.

        Returns:
            Whether it was recorded; not if the run was done already.

        Raises:
            OutputError: The ledger cannot be written.
        """
        with self._transaction() as db:
            changed = db.execute(
                "UPDATE runs SET status = 'done', result = ?, error = '', finished = ?"
                " WHERE key = ? AND status != 'done'",
                (result.to_json(), time.time(), key),
            )
        return bool(changed.rowcount)

    def fail(self, key: str, worker: str, error: str) -> None:
        """Record that a worker's run failed.

        Raises:
            OutputError: The ledger cannot be written.
        """
        self._end(key, worker, "failed", error)

    def release(self, key: str, worker: str) -> None:
        """Hand back a worker's run, to be resumed.

        Raises:
            OutputError: The ledger cannot be written.
        """
        self._end(key, worker, "pending", "")

    def _end(self, key: str, worker: str, status: str, error: str) -> None:
        with self._transaction() as db:
            db.execute(
                "UPDATE runs SET status = ?, error = ?, finished = ?"
                " WHERE key = ? AND worker = ? AND status = 'running'",
                (status, error, time.time(), key, worker),
            )

    def retry_failed(self, among: Collection[str]) -> int:
        """Let failed runs be taken again; returns how many.

        Raises:
            OutputError: The ledger cannot be written.
        """
        with self._transaction() as db:
            failed = [key for (key,) in db.execute("SELECT key FROM runs WHERE status = 'failed'")]
            again = [(key,) for key in failed if key in among]
            db.executemany("UPDATE runs SET status = 'pending', error = '' WHERE key = ?", again)
        return len(again)

    def rows(self) -> list[RunRow]:
        """All runs, in the order in which they were entered.

        Raises:
            OutputError: The ledger cannot be read.
        """
        with self._transaction() as db:
            records = db.execute(
                "SELECT spec, status, result, error, attempts, worker, started, finished"
                " FROM runs ORDER BY position"
            ).fetchall()
        try:
            return [
                RunRow(RunSpec.from_json(spec), status, _result(result), *rest)
                for spec, status, result, *rest in records
            ]
        except (ValueError, KeyError, TypeError) as error:
            raise SceneFormatError(
                f"runs in {self.path} as this version of splatseed, or an earlier one, writes them",
                found=f"a run of another layout ({type(error).__name__}: {error})",
                fix="Read it with the version that wrote it, or begin a new folder.",
            ) from None

    def note_session(self, facts: Mapping[str, Any]) -> None:
        """Record the facts about a call of the command: its words, versions, machine.

        Raises:
            OutputError: The ledger cannot be written.
        """
        with self._transaction() as db:
            values = (time.time(), json.dumps(facts, sort_keys=True))
            db.execute("INSERT INTO sessions (started, facts) VALUES (?, ?)", values)

    def sessions(self) -> list[dict[str, Any]]:
        """The recorded calls, oldest first, with ``started`` in seconds since 1970.

        Raises:
            OutputError: The ledger cannot be read.
        """
        with self._transaction() as db:
            records = db.execute("SELECT started, facts FROM sessions ORDER BY id").fetchall()
        return [{**json.loads(facts), "started": started} for started, facts in records]

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        """A connection for one transaction, committed if the block ends without an error."""
        try:
            with closing(self._connect()) as db:
                db.execute("BEGIN" if self._read_only else "BEGIN IMMEDIATE")
                try:
                    yield db
                except BaseException:
                    db.rollback()
                    raise
                db.execute("COMMIT")
        except sqlite3.OperationalError as error:
            raise OutputError(
                f"a ledger at {self.path} that can be {'read' if self._read_only else 'written'}",
                found=str(error),
                fix="Check the disk and its rights, and that it supports file locks.",
            ) from error
        except sqlite3.DatabaseError as error:
            raise _foreign(self.path, str(error)) from error

    def _connect(self) -> sqlite3.Connection:
        """A connection; one that may write if a killed writer's transaction must be undone."""
        journal = self.path.with_name(self.path.name + "-journal")
        undo = journal.is_file() and os.access(self.path, os.W_OK)
        mode = "rwc" if not self._read_only else "rw" if undo else "ro"
        uri = f"{self.path.resolve().as_uri()}?mode={mode}"
        return sqlite3.connect(uri, uri=True, timeout=BUSY_SECONDS, isolation_level=None)


def _result(text: str | None) -> RunResult | None:
    return None if text is None else RunResult.from_json(text)


def _is_new(db: sqlite3.Connection) -> bool:
    (tables,) = db.execute("SELECT count(*) FROM sqlite_master").fetchone()
    return not tables


def _check_kind(db: sqlite3.Connection, path: Path) -> None:
    (kind,) = db.execute("PRAGMA application_id").fetchone()
    (schema,) = db.execute("PRAGMA user_version").fetchone()
    if kind != APPLICATION_ID:
        raise _foreign(path, "another program's database")
    if schema > SCHEMA:
        raise SceneFormatError(
            f"{path} to be a ledger of this version of splatseed",
            found=f"one of a newer version (schema {schema}, here {SCHEMA})",
            fix="Update splatseed.",
        )


def _foreign(path: Path, found: str) -> SceneFormatError:
    return SceneFormatError(
        f"{path} to be a benchmark's ledger", found=found, fix="Name another folder."
    )
