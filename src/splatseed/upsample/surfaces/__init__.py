"""Height fields over neighbourhoods: frames, patches, where to sample, splines."""
