"""Voronoi cells: the paper's, in a bounding box, and the default's, from neighbours alone."""
