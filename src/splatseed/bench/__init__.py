"""The benchmark: does upsampling help on these scenes, by which method, at what cost?"""

from __future__ import annotations

__all__: list[str] = []
