"""Gaussians without a trainer: made from seeds, in files, in the training frame, rendered."""
