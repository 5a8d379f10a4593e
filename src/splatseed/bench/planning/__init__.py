"""Before a benchmark: its scenes and arms, the runs they make, how long those will take."""
