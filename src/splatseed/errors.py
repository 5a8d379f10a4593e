"""The errors that splatseed raises on purpose; any other is a bug.

The message says in one line what was expected, what was found, and how to fix it::

    SplatseedError
    ├── InputError    the user's data or options
    │   ├── SceneNotFoundError (FileNotFoundError), SceneFormatError, OutputError
    │   └── PointCloudError, ParameterError (ValueError)
    │       └── UnknownNameError (KeyError)
    └── ReconstructionError, MissingDependencyError, PluginError, TaskLostError

A message names an argument in backticks, as Python code: `ratio`, `max_steps=7000`,
`overwrite=True`. The command line prints the option instead (`--ratio`, `--max-steps 7000`,
`--overwrite`, or a line of its --config file; ``console.with_options``), so messages of the library
contain no options. Text values are quoted: ``f"`masks={str(folder)!r}`"``. Notes follow the same
rule.

The classes in parentheses are Python's, which callers may catch. Inside splatseed, an ``except
OSError`` or ``except ValueError`` that converts errors must re-raise a ``SplatseedError``.
"""

from __future__ import annotations

from functools import partial


class SplatseedError(Exception):
    """Base of every error raised on purpose.

    Args:
        expected: What was expected, naming the file, line or record.
        found: What was found instead.
        fix: What the user can do.
    """

    def __init__(self, expected: str, *, found: str, fix: str) -> None:
        super().__init__(f"expected {expected}; found {found}. {fix}")
        self.expected = expected
        self.found = found
        self.fix = fix

    def __str__(self) -> str:
        """Return the message; ``KeyError`` would quote it."""
        return str(self.args[0])

    def __reduce__(self) -> tuple[partial[SplatseedError], tuple[str], dict[str, object]]:
        """Make errors with keyword-only arguments picklable; keeps their notes."""
        return partial(type(self), found=self.found, fix=self.fix), (self.expected,), vars(self)


class InputError(SplatseedError):
    """The user's data or arguments are wrong."""


class SceneNotFoundError(InputError, FileNotFoundError):
    """A scene, model, image or file does not exist."""


class SceneFormatError(InputError):
    """A file does not follow its format."""


class PointCloudError(InputError, ValueError):
    """Point arrays of the wrong shape or type, or too few usable points."""


class ParameterError(InputError, ValueError):
    """An argument is out of its range."""


class UnknownNameError(ParameterError, KeyError):
    """No choice has this name."""


class OutputError(InputError):
    """The output cannot or must not be written there."""


class ReconstructionError(SplatseedError):
    """Structure-from-Motion failed."""


class MissingDependencyError(SplatseedError):
    """An optional package is not installed."""


class PluginError(SplatseedError):
    """The method of another package failed; ``__cause__`` is its exception."""


class TaskLostError(SplatseedError):
    """The process or node of a task died too often."""
