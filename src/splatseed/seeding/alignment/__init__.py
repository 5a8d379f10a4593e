"""Finding where a cloud lies in a scene: similarity, from the scene's own points alone.

``sampling`` takes an even sample of a cloud, ``coarse`` tries all orientations, ``icp`` refines,
``align`` judges and refuses what is not sure. Import from the modules.
"""
