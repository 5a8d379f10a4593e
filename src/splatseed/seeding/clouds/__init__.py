"""Seeds from clouds of any size: aligned, streamed, thinned to what photographs show, checked."""
