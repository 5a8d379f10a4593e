"""Before a benchmark: its scenes and arms, the runs they make, and how long those will take."""
