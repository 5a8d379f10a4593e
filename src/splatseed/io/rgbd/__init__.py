"""Captures of cameras with a depth sensor, in the layouts of Replica and TUM."""
