"""The analysis of finished runs: studies, statistics, gains, and their tables."""
