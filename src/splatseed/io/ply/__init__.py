"""PLY files: points, and recognising trained Gaussians without reading them."""
