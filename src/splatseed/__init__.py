"""Better seeds for 3D Gaussian Splatting."""
