"""Seeds from scans and dense clouds: alignment, merging in voxels, photo-consistency."""
