"""The check-up: photographs, poses, intrinsics and points of a capture held against each other."""
