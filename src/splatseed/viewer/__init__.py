"""Looking at scenes and models: pictures, the viewer in the browser, flights."""
