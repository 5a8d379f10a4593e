"""The folder of a benchmark: permission to write, and the synthetic room in it.

Notation: ``BENCH`` holds ``ledger.sqlite``, ``plan.toml``, ``runs/`` with what is kept of each run,
``work/`` with runs that go on, and ``scenes/demo`` if a plan asks for it. Promise: a folder that is
neither empty nor a benchmark's is never written to.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from splatseed.bench.planning.scenes import SceneFacts
from splatseed.bench.running.ledger import LEDGER, Ledger
from splatseed.errors import OutputError
from splatseed.io.staging import MANIFEST, check_output, read_manifest, write_json

DEMO_FACTS = SceneFacts(
    "demo",
    "demo:",
    "not made yet",
    11_364,
    40,
    400 * 300,
    depth_digest="not made yet",
    long_side=400,
)
"""Facts about the synthetic room before it is made; the number of points is approximate."""


PLAN, TUNING = "plan.toml", "tune.json"
"""What ``splatseed bench`` and ``splatseed tune`` put beside their ledgers."""


def check_bench_folder(folder: Path, protect: Sequence[Path] = (), *, tunes: bool = False) -> None:
    """Refuse a folder that is not a benchmark's, before any work is done.

    Args:
        folder: The folder, which need not be there.
        protect: Scenes, which the folder must lie apart from.
        tunes: Whether it is to be that of ``splatseed tune``.

    Raises:
        OutputError: It is another's, or lies in a scene or around one.
        SceneFormatError: Its ledger is not one that this version knows.
    """
    ledger = folder / LEDGER
    if ledger.is_file() and ledger.stat().st_size:  # else another process is about to write it
        Ledger.open(ledger, read_only=True)
    verb, other, mark = ("tune", "bench", PLAN) if tunes else ("bench", "tune", TUNING)
    if (folder / mark).is_file():
        raise OutputError(
            f"the folder of splatseed {verb}, or a new one, at {folder}",
            found=f"what splatseed {other} wrote",
            fix="Choose another folder.",
        )
    marked = (folder / MANIFEST).is_file() and not (folder / LEDGER).exists()
    if marked and _command(folder) != "bench":
        raise OutputError(
            f"the folder of a benchmark, or a new one, at {folder}",
            found=f"what splatseed {_command(folder)} wrote",
            fix="Choose another folder.",
        )
    if not marked and not (folder / LEDGER).is_file():
        check_output(folder, kind="bench", protect=protect)
        return
    for scene in protect:
        within = folder.resolve() in scene.resolve().parents
        if within and scene.resolve() != (folder / "scenes" / "demo").resolve():
            check_output(folder, kind="bench", overwrite=True, protect=[scene])


def make_bench_folder(folder: Path) -> None:
    """Make the folder and mark it as a benchmark's, unless it exists.

    Raises:
        OutputError: It cannot be written.
    """
    if not (folder / MANIFEST).is_file():
        write_json(folder / MANIFEST, {"command": "bench"})


def make_demo_scene(folder: Path) -> Path:
    """The synthetic room of ``splatseed demo``, in a folder; made unless it exists.

    Args:
        folder: Where to.

    Returns:
        Its place.

    Raises:
        OutputError: It cannot be written.
    """
    path = folder / "demo"
    if path.is_dir():
        return path
    from splatseed.synthetic import make_capture, write_capture  # noqa: PLC0415  (Numba)

    try:
        return write_capture(make_capture(), path)
    except OutputError:
        if path.is_dir():  # another process was faster
            return path
        raise


def _command(folder: Path) -> str:
    """What wrote a folder, by its manifest."""
    return str(read_manifest(folder).get("command", "something else"))
