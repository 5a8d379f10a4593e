"""Points from depth maps, pixel by pixel, and the maps that ``stereo`` and ``monocular`` make.

Promise: photographs and maps are read one at a time by each thread, whatever the number of images.
"""
