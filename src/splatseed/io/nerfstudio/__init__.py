"""Cameras in ``transforms.json``, as nerfstudio, instant-ngp and Blender's data sets have them."""
