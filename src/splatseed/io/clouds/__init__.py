"""Clouds from elsewhere: scans, dense reconstructions, point maps, read in chunks at any size.

``open_cloud`` recognises the format; a ``CloudFile`` says what its header promises and gives its
points in chunks, in the file's own coordinates. One module per format. Promise: importing this
package loads none of the optional packages that read formats.
"""

from splatseed.io.clouds.cloud_file import CloudChunk, CloudFile
from splatseed.io.clouds.opening import open_cloud

__all__ = ["CloudChunk", "CloudFile", "open_cloud"]
