"""One function call in a fresh Python process.

``multiprocessing`` does not serve: its spawned processes run the caller's script again, import from
the working directory (a ``numpy.py`` there would be executed), and do not tell why they died. A
``Child`` does neither, is killed with ``close``, and ends when its parent ends, even by a kill.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import IO, Any, TypeAlias, cast

from splatseed.errors import SplatseedError, TaskLostError
from splatseed.progress import Progress, silent

Function: TypeAlias = Callable[..., Any]
_PROGRAM = "from splatseed.runtime.child import serve; serve()"
_REPORT_SECONDS = 0.5
_MAX_LOG_WORDS = 40
"""The last words of a dead process's output that go into the error."""


class Child:
    """A process that starts to call a function at once; ``result`` waits for it.

    Args:
        function: A function at the top level of a module.
        arguments: Its arguments, which must be picklable.
        reports: Whether to pass the function a ``progress``, too.
        environment: Variables to set.
        log: The file that takes the process's output; ``close`` closes it. The terminal if None.
    """

    def __init__(
        self,
        function: Function,
        *arguments: object,
        reports: bool = False,
        environment: Mapping[str, str] | None = None,
        log: IO[bytes] | None = None,
    ) -> None:
        # An empty entry would stand for the working directory.
        paths = os.pathsep.join(filter(None, sys.path))
        self._log = log
        self.process = subprocess.Popen(  # noqa: S603  (our own interpreter and module)
            [sys.executable, "-P", "-c", _PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            env={**os.environ, "PYTHONPATH": paths, "PYTHONSAFEPATH": "1", **(environment or {})},
            process_group=0,  # Ctrl-C reaches the parent alone
        )
        calls = cast("IO[bytes]", self.process.stdin)
        with suppress(BrokenPipeError):  # it has died, which ``result`` reports
            calls.write(pickle.dumps((function, arguments, reports)))
            calls.flush()

    def result(self, progress: Progress = silent) -> Any:
        """Wait for what the function returns or raises.

        Raises:
            TaskLostError: The process died.
        """
        replies = cast("IO[bytes]", self.process.stdout)
        try:
            while (reply := pickle.load(replies))[0] == "progress":  # noqa: S301  (our child)
                progress(*reply[1:])
        except (EOFError, pickle.UnpicklingError):
            raise self._death() from None
        if reply[0] == "error":
            raise reply[1]
        return reply[1]

    def close(self) -> None:
        """Kill the process if it still runs, and close its files."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout, self._log):
            with suppress(BrokenPipeError):
                if pipe is not None:
                    pipe.close()

    def _death(self) -> TaskLostError:
        code = self.process.wait()
        found = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        if self._log is not None:
            self._log.seek(0)
            words = self._log.read().decode("utf-8", "replace").split()[-_MAX_LOG_WORDS:]
            found += f": {' '.join(words)}" if words else ""
        return TaskLostError(
            "a process that runs to its end",
            found=found,
            fix="Out of memory? Run fewer jobs at a time, or pass smaller settings.",
        )


def serve() -> None:
    """Be the child: make the call that the parent sent, reply, and exit."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print goes to the log
    reported = ("", 0.0)

    def reply(*message: object) -> None:
        replies.write(pickle.dumps(message))
        replies.flush()

    def progress(stage: str, fraction: float) -> None:
        nonlocal reported
        late = time.monotonic() - reported[1] > _REPORT_SECONDS
        if stage != reported[0] or fraction >= 1.0 or late:
            reported = (stage, time.monotonic())
            reply("progress", stage, float(fraction))

    try:
        function, arguments, reports = pickle.load(sys.stdin.buffer)  # noqa: S301  (our parent)
        threading.Thread(target=_exit_with_parent, daemon=True).start()
        try:
            reply("value", function(*arguments, **({"progress": progress} if reports else {})))
        except Exception as error:  # noqa: BLE001  (the parent handles it)
            if not isinstance(error, SplatseedError) or error.__cause__:  # of another's code
                error.add_note(traceback.format_exc())
            reply("error", error)
    except BaseException:  # noqa: BLE001  (the process ends here)
        traceback.print_exc()
        os._exit(1)
    os._exit(0)  # at once: an ordinary exit could wait for the other thread


def _exit_with_parent() -> None:
    """End this process when the parent's end closes the pipe."""
    while os.read(0, 1):
        pass
    os._exit(1)
