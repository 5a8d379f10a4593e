"""Seeds from clouds of any size: streamed, thinned to what photographs resolve, and checked.

``voxels`` merges points while they are read, ``evidence`` finds what the photographs see of them,
``method`` makes a method of it.
"""
