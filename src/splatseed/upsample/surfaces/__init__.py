"""Height fields over neighbourhoods: frames, patches, placement, splines."""
