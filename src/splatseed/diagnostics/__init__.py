"""Statistics of scenes and clouds: what is wrong with a scene, how far points are from surfaces."""
