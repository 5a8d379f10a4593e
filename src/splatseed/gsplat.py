"""The old name of ``splatseed.integrations.gsplat``, kept for one release."""

from splatseed.integrations.gsplat import GrowStrategy as GrowStrategy  # noqa: PLC0414
