"""Freed memory is kept where there is glibc."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource
from splatseed.process.allocator import keep_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    bytearray(64 << 20)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

faults()
freed = faults()
keep_freed_memory()
faults()
print(freed, faults())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc's option")
def test_what_is_freed_is_used_again():
    # A process of its own: the option holds until it ends.
    command = [sys.executable, "-c", FAULTS]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    freed, kept = map(int, printed.split())
    assert kept < freed / 10
