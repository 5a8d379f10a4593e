"""Densification strategies: ``base`` is their interface; ``default``, ``mcmc`` and ``grow``."""
