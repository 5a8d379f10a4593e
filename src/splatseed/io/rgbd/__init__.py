"""Captures of RGB-D cameras, in the layouts of Replica and TUM."""
