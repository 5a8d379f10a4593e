"""PLY files: points, and what of trained Gaussians is recognised without being read."""
