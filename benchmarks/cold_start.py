"""How long a newcomer waits: ``make demo`` from a copy of the tree, nothing installed or compiled.

    python -m benchmarks.cold_start [--kernels 30]

It copies the files that git knows to a temporary folder, so that there is no ``.venv`` and no
machine code, gives pip an empty cache, runs ``make demo`` there, and notes when each thing it waits
for has come. With ``--kernels N`` it then runs the demo once more with an empty cache, in one
process, and lists the N kernels that took longest to compile. Prints Markdown.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import nullcontext, redirect_stdout
from pathlib import Path

from benchmarks.common.machine import describe, warn_if_busy
from benchmarks.common.markdown import table

ROOT = Path(__file__).parents[1]
MARKS = {
    "splatseed installed": ".venv/.base",
    "first picture (preview.png)": "demo/preview.png",
    "PyTorch installed": ".venv/.train",
    "every method measured (geometry.csv)": "demo/geometry.csv",
    "every method shown (preview_errors.png)": "demo/preview_errors.png",
    "all runs trained (preview_trained.png)": "demo/preview_trained.png",
}
POLL = 0.1


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kernels", type=int, default=0, metavar="N", help="list N kernels")
    parser.add_argument("--keep-pip-cache", action="store_true", help="let pip use what it has")
    options = parser.parse_args()
    warn_if_busy()
    print(describe(), end="\n\n")
    with tempfile.TemporaryDirectory(prefix="cold-start-") as folder:
        tree = copy_tree(Path(folder) / "splatseed")
        environment = cold_environment(Path(folder), keep_pip_cache=options.keep_pip_cache)
        times, rows = time_demo(tree, environment)
        print(table(["what", "s after `make demo`"], rows))
        print(f"\nCPU: {times:.0f} s.")
        if options.kernels:
            print()
            list_kernels(tree, environment, options.kernels)


def copy_tree(target: Path) -> Path:
    """The files that git knows, as they are now, without anything made from them."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    for name in filter(None, names.split("\0")):
        if (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target / name)
    return target


def cold_environment(folder: Path, *, keep_pip_cache: bool) -> dict[str, str]:
    """Ours, without what speeds up a second time."""
    ours = {"PYTHONPATH", "VIRTUAL_ENV", "NUMBA_CACHE_DIR", "PYTHONPYCACHEPREFIX"}
    environment = {name: value for name, value in os.environ.items() if name not in ours}
    environment["MPLCONFIGDIR"] = str(folder / "matplotlib")
    if not keep_pip_cache:
        environment["PIP_CACHE_DIR"] = str(folder / "pip")
    return environment


def time_demo(tree: Path, environment: Mapping[str, str]) -> tuple[float, list[list[str]]]:
    """CPU seconds of ``make demo``, and a row for each thing that it brings."""
    before, start = _cpu_seconds(), time.monotonic()
    seen: dict[str, float] = {}
    with (tree / "demo.log").open("w") as log:
        process = subprocess.Popen(
            ["make", "demo"], cwd=tree, env=environment, stdout=log, stderr=subprocess.STDOUT
        )
        while process.poll() is None:
            for what, mark in MARKS.items():
                if what not in seen and (tree / mark).exists():
                    seen[what] = time.monotonic() - start
            time.sleep(POLL)
    seen["end"] = time.monotonic() - start
    print((tree / "demo.log").read_text(), file=sys.stderr)
    if process.returncode:
        sys.exit(f"make demo failed with {process.returncode}")
    rows = [[what, f"{seconds:.0f}"] for what, seconds in sorted(seen.items(), key=lambda x: x[1])]
    return _cpu_seconds() - before, rows


def _cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def list_kernels(tree: Path, environment: Mapping[str, str], num: int) -> None:
    """Run the demo in one process with nothing compiled, and print what compiling took."""
    with tempfile.TemporaryDirectory() as cache:
        subprocess.run(
            [".venv/bin/python", "-m", "benchmarks.cold_start", "--inside", str(num), "demo_again"],
            cwd=tree,
            env={**environment, "NUMBA_CACHE_DIR": cache},
            check=True,
        )


def inside(num: int, output: str) -> None:
    """Run the demo here, and print the CPU seconds of compiling each kernel with its helpers."""
    from numba.core import event  # noqa: PLC0415  (only there is it installed)

    from splatseed.commands import demo  # noqa: PLC0415  (loads with its use)

    running: list[tuple[str, float]] = []
    spent: Counter[str] = Counter()

    class _Clock(event.Listener):
        def on_start(self, event: event.Event) -> None:
            function = event.data["dispatcher"].py_func
            running.append((f"{function.__module__}.{function.__name__}", time.process_time()))

        def on_end(self, event: event.Event) -> None:  # noqa: ARG002  (the interface's name)
            name, begun = running.pop()
            if not running:
                spent[name] += time.process_time() - begun

    demo.compiled_ahead = lambda _: nullcontext(lambda: None)  # replaced for the measurement
    with redirect_stdout(sys.stderr), event.install_listener("numba:compile", _Clock()):
        demo.run(["--output", output, "--train-steps", "20"])
    rows = [[name, f"{seconds:.1f}"] for name, seconds in spent.most_common(num)]
    print()
    print(table(["kernel and its helpers", "CPU s to compile"], rows))
    print(f"\nAll {len(spent)}: {sum(spent.values()):.0f} s.")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--inside"]:
        inside(int(sys.argv[2]), sys.argv[3])
    else:
        main()
