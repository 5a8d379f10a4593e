"""The process in which pycolmap runs."""

from __future__ import annotations

import subprocess
import sys

WAITS = """
from threading import Thread
from time import sleep
from splatseed.sfm.worker import _end_with
Thread(target=_end_with, args=(0,), daemon=True).start()
print("ready", flush=True)
sleep(60)
"""


def test_it_ends_when_its_parent_is_gone():
    words = [sys.executable, "-c", WAITS]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout.readline() == b"ready\n"
        assert child.poll() is None
        child.stdin.close()  # as the system does it for a parent that was killed
        assert child.wait(timeout=20) == 1
