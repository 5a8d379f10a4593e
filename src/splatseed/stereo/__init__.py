"""Depth and normals from photographs alone, on the CPU."""
