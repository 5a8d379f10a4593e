"""splatseed inside other trainers."""
