"""Freed memory goes back to the system."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

HELD = """
import numpy as np, sys
from stereo_sfm.pipeline.allocator import return_large_blocks
if sys.argv[1] == "on":
    return_large_blocks()
del_me = np.ones(30 << 20, np.uint8)
del del_me  # without the setting, blocks up to this size lie in the heap from now on
def resident():
    return int(open("/proc/self/statm").read().split()[1]) >> 8  # MiB of 4 KiB pages
before, small = resident(), []
for _ in range(20):
    large = np.ones(4 << 20, np.uint8)
    small += [bytes(900) for _ in range(50)]
    larger = np.ones(6 << 20, np.uint8)
    small += [bytes(900) for _ in range(50)]
    small.append(large)
large = larger = None
small = [block for block in small if isinstance(block, bytes)]
print(resident() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="an allocator of glibc's")
def test_room_between_small_blocks_is_returned() -> None:
    def held(setting: str) -> int:
        done = subprocess.run([sys.executable, "-c", HELD, setting], capture_output=True, text=True, check=True)
        return int(done.stdout)

    assert held("on") < 10 < 30 < held("off")


THREADS = """
import sys, threading
from stereo_sfm.pipeline.allocator import share_one_heap
if sys.argv[1] == "on":
    share_one_heap()
together = threading.Barrier(6)
def work():
    together.wait()
    kept.append([bytes(5000) for _ in range(200)])
    together.wait()
kept, threads = [], [threading.Thread(target=work) for _ in range(6)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
lines = [line.split() for line in open("/proc/self/maps")]
starts = [int(line[0].partition("-")[0], 16) for line in lines if len(line) == 5]
print(sum(start % (64 << 20) == 0 for start in starts))  # where glibc puts the heaps of threads
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="an allocator of glibc's")
def test_threads_share_one_heap() -> None:
    def heaps(setting: str) -> int:
        done = subprocess.run([sys.executable, "-c", THREADS, setting], capture_output=True, text=True, check=True)
        return int(done.stdout)

    assert heaps("on") == 0
    assert heaps("off") > 2


STEPS = """
import sys
from stereo_sfm.pipeline.allocator import Release
small = [bytes(5000) for _ in range(20_000)]
del small[1::2], small[1::2], small[1::2]  # what is kept lies between what is free
def resident():
    return int(open("/proc/self/statm").read().split()[1]) >> 8
tidy, before = Release(3), resident()
for _ in range(int(sys.argv[1])):
    tidy.step()
print(before - resident())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="an allocator of glibc's")
def test_free_pages_are_returned_every_so_many_steps() -> None:
    def returned(steps: int) -> int:
        done = subprocess.run([sys.executable, "-c", STEPS, str(steps)], capture_output=True, text=True, check=True)
        return int(done.stdout)

    assert returned(2) == 0
    assert returned(3) > 20
