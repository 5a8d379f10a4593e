"""Training: from a scene and its seeds to Gaussians that look like the photographs."""

from __future__ import annotations

__all__: list[str] = []
