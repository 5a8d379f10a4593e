"""Where the time of a render or a training step goes, without a change to what is timed.

Notation: a *stage* is some of the package's functions; its time is its own, less that of stages
that it calls, by one of ``clocks``. Promise: functions are replaced by ones that call them and look
at the clock, and put back afterwards; a stage that never ran is an error, so that a renamed
function cannot read as no time.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

from benchmarks.common.clocks import Clock, start_clock

from splatseed.rendering import autograd
from splatseed.rendering._kernels import blending, blending_vjp
from splatseed.rendering.autograd import Blend, Harmonics, Project

__all__ = ["RENDER_STAGES", "Stopwatch", "timed"]

Place = tuple[Any, str]
"""An object and the name of the function in it."""

RENDER_STAGES: Mapping[str, Sequence[Place]] = {
    "project": ((Project, "forward"),),
    "harmonics": ((Harmonics, "forward"),),
    "bin": ((autograd, "_prepare"),),
    "blend layout": ((Blend, "forward"),),
    "blend kernel": ((blending, "forward"),),
    "project backward": ((Project, "backward"),),
    "harmonics backward": ((Harmonics, "backward"),),
    "blend layout backward": ((Blend, "backward"),),
    "blend kernel backward": ((blending_vjp, "backward"), (blending_vjp, "sum_spans")),
}
"""The rasteriser's. ``layout`` is what stands around the kernels of blending: it moves arrays."""


class Stopwatch:
    """Seconds by stage, since the last ``lap``.

    Args:
        clock: Which. For ``cpu``, threads must have started.
    """

    def __init__(self, clock: Clock = "wall") -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.ever: set[str] = set()
        self._now = start_clock(clock)
        self._inner: list[Any] = []

    def lap(self) -> dict[str, float]:
        """The seconds so far; counting begins anew."""
        seconds, self.seconds = dict(self.seconds), defaultdict(float)
        self.ever.update(seconds)
        return seconds

    def wrap(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function``, timed."""

        def timed_function(*args: Any, **kwargs: Any) -> Any:
            self._inner.append(0.0)
            started = self._now()
            try:
                return function(*args, **kwargs)
            finally:
                took = self._now() - started
                self.seconds[stage] += float((took - self._inner.pop()).max())
                if self._inner:
                    self._inner[-1] += took

        return timed_function


@contextmanager
def timed(stages: Mapping[str, Sequence[Place]], clock: Clock = "wall") -> Iterator[Stopwatch]:
    """Time the stages within the block.

    Raises:
        RuntimeError: A stage never ran.
    """
    watch = Stopwatch(clock)
    with ExitStack() as undo:
        for stage, places in stages.items():
            for owner, name in places:
                undo.callback(_replace(owner, name, watch.wrap(stage, getattr(owner, name))))
        yield watch
    watch.lap()
    if missing := set(stages) - watch.ever:
        raise RuntimeError(f"stages that never ran: {', '.join(sorted(missing))}")


def _replace(owner: Any, name: str, function: Callable[..., Any]) -> Callable[[], None]:
    """Put the function there; returns what puts back the original."""
    is_own, original = name in vars(owner), vars(owner).get(name)
    setattr(owner, name, staticmethod(function) if isinstance(owner, type) else function)
    return partial(setattr, owner, name, original) if is_own else partial(delattr, owner, name)
