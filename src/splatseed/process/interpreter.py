"""Child processes that run our own code in our own interpreter.

Promise: the working directory, which may hold anybody's files, plays no part in a child's imports:
a ``numpy.py`` that lies there is never executed.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

SAFE = "PYTHONSAFEPATH"
"""The variable that keeps the working directory out of an interpreter's ``sys.path``."""


def child_command(program: str, *words: str) -> list[str]:
    """The command that runs a short program in a new interpreter.

    Args:
        program: Python code.
        words: The child's ``sys.argv[1:]``.
    """
    # Without -P, python -c puts the working directory before all else on sys.path.
    return [sys.executable, "-P", "-c", program, *words]


def child_environment(more: Mapping[str, str] | None = None) -> dict[str, str]:
    """The environment of a child: ours, plus the paths we import from.

    Args:
        more: Variables to set on top.
    """
    # An empty entry would stand for the working directory.
    places = os.pathsep.join(filter(None, sys.path))
    return {**os.environ, "PYTHONPATH": places, SAFE: "1", **(more or {})}


@contextmanager
def safe_children() -> Iterator[None]:
    """Keep this module's promise for the interpreters that ``multiprocessing`` starts in the block.

    It runs ``python -c`` with our environment, and then hands on our ``sys.path``.
    """
    variable, path = os.environ.get(SAFE), sys.path
    os.environ[SAFE] = "1"
    sys.path = list(filter(None, path))
    try:
        yield
    finally:
        sys.path = path
        if variable is None:
            del os.environ[SAFE]
        else:
            os.environ[SAFE] = variable
