"""Benchmarks: plan, run, analyse and report which seeds help, and at what cost."""

from __future__ import annotations

__all__: list[str] = []
