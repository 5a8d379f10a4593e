"""The benchmark: does upsampling help on these scenes, by which method, at what cost?

The flow: a plan lists runs, executors run them, the ledger remembers them, statistics compare them,
and the report shows the results.
"""

from __future__ import annotations

__all__: list[str] = []
