"""What reading a damaged archive of arrays can raise."""

from __future__ import annotations

import lzma
import struct
import tokenize
import zipfile
import zlib

ARRAY_FAILURES = (
    *(ValueError, TypeError, KeyError, IndexError, OverflowError, MemoryError, SyntaxError),
    EOFError,
    RecursionError,
    tokenize.TokenError,  # of headers that look like Python 2's
)
"""What NumPy raises for a damaged ``.npy``: it parses the header as Python."""
ARCHIVE_FAILURES = (
    *ARRAY_FAILURES,
    *(OSError, zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error),
    RuntimeError,  # encrypted, or compressed in a way that zipfile does not know
)
"""What a damaged ``.zip`` or ``.npz`` can raise besides."""
