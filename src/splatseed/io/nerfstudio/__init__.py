"""Cameras in ``transforms.json``, as in the data sets of nerfstudio, instant-ngp and Blender."""
