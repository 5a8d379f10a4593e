"""Gaussians without a trainer: from seeds, in files, in the frame of training, seen from a view."""
