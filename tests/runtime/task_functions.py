"""Functions that children call in ``test_tasks``; they do not import pytest."""

from __future__ import annotations

import os
import signal
import time
from importlib import import_module

from splatseed.errors import OutputError, ParameterError
from splatseed.progress import silent


def fail(what, progress=silent):
    progress("half", 0.5)
    if what == "bug":
        raise ValueError(what)
    if what:
        raise ParameterError(what, found="it", fix="Mend it.")
    return len(os.environ.get("OMP_NUM_THREADS", ""))


def die(when, flag):
    if when == "always":
        os.write(2, b"no memory is left")
        os.abort()
    if when == "once" and not flag.exists():
        flag.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "lived"


def wait_for_term(flag):
    signal.signal(signal.SIGTERM, lambda *_: flag.with_suffix(".saved").touch())
    flag.touch()
    for _ in range(1200):
        if flag.with_suffix(".saved").exists():
            return "saved"
        time.sleep(0.05)
    return "not asked"


def raise_unpicklable():
    """What cannot be carried over is an error, not a hang."""
    error = OutputError("a", found="b", fix="c")
    error.fix = lambda: None
    raise error


def import_all(names):
    return [import_module(name) for name in names] and import_module("splatseed").__file__
