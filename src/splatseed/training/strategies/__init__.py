"""Densification strategies: ``base`` is their interface, ``training.traits`` lists their files."""
