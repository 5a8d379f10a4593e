"""Looking at scenes and models: camera paths, videos, and the viewer in the browser."""
