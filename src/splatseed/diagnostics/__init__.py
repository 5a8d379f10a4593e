"""Numbers about scenes and clouds: what is wrong with one, how far points lie from surfaces."""
