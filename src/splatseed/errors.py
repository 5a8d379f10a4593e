"""The errors that splatseed raises on purpose; anything else that escapes is a bug of ours.

Each says what was expected, what was found and how to mend it, in one line a user can act on::

    SplatseedError
    ├── InputError    the user's data or options
    │   ├── SceneNotFoundError (FileNotFoundError), SceneFormatError, OutputError
    │   └── PointCloudError, ParameterError (ValueError)
    │       └── UnknownNameError (KeyError)
    └── ReconstructionError, MissingDependencyError, TaskLostError

A message names an argument in backticks, as Python code: `ratio`, `max_steps=7000`,
`overwrite=True`. The command line prints the option instead (`--ratio`, `--max-steps 7000`,
`--overwrite`; ``console.with_options``), so messages of the library contain no options. Text values
are quoted: ``f"`masks={str(folder)!r}`"``. Notes follow the same rule.

Those in parentheses are also Python's own, which callers may expect: an ``except OSError`` or
``except ValueError`` around code that raises ours must let them pass first.
"""

from __future__ import annotations

from functools import partial


class SplatseedError(Exception):
    """Base of every error raised on purpose.

    Args:
        expected: What should have been there, naming the file, line or record.
        found: What was there instead.
        fix: What the user can do about it.
    """

    def __init__(self, expected: str, *, found: str, fix: str) -> None:
        super().__init__(f"expected {expected}; found {found}. {fix}")
        self.expected = expected
        self.found = found
        self.fix = fix

    def __str__(self) -> str:
        """The sentence; ``KeyError`` would quote it."""
        return str(self.args[0])

    def __reduce__(self) -> tuple[partial[SplatseedError], tuple[str]]:
        """Makes errors with keyword-only arguments picklable."""
        return partial(type(self), found=self.found, fix=self.fix), (self.expected,)


class InputError(SplatseedError):
    """The user's data or options are at fault."""


class SceneNotFoundError(InputError, FileNotFoundError):
    """There is no scene, model, image or file where one was named."""


class SceneFormatError(InputError):
    """A file is there but is not what its format promises."""


class PointCloudError(InputError, ValueError):
    """Point arrays of the wrong shape or type, or too few usable points."""


class ParameterError(InputError, ValueError):
    """An option or a method's parameter is out of its range."""


class UnknownNameError(ParameterError, KeyError):
    """There is nothing of that name to choose."""


class OutputError(InputError):
    """The output cannot, or must not, be written where it was asked for."""


class ReconstructionError(SplatseedError):
    """Structure-from-Motion ran and did not succeed."""


class MissingDependencyError(SplatseedError):
    """An optional package is needed and absent."""


class TaskLostError(SplatseedError):
    """A task was lost with its process or node too often."""
