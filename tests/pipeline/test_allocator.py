"""Freed memory goes back to the system."""

from __future__ import annotations

import pickle
import platform
import subprocess
import sys

import numpy as np
import pytest

from stereo_sfm.pipeline.allocator import in_own_pages
from stereo_sfm.types import Keyframe

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


KEPT = """
import sys
import numpy as np
from stereo_sfm.pipeline.allocator import in_own_pages
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096
kept = []
for k in range(200):
    came = [np.full(size, k) for size in range(100, 1000, 20)]
    kept.append(in_own_pages(came) if sys.argv[1] == "on" else came)
before = resident()
dropped = sum(array.nbytes for message in kept[1::2] for array in message)
del kept[1::2]
print((before - resident()) / dropped)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="an allocator of glibc's")
def test_a_message_in_its_own_pages_leaves_no_room_behind() -> None:
    def returned(setting: str) -> float:
        done = subprocess.run([sys.executable, "-c", KEPT, setting], capture_output=True, text=True, check=True)
        return float(done.stdout)

    assert returned("on") > 0.95
    assert returned("off") < 0.05


def test_a_message_in_its_own_pages_is_the_same() -> None:
    keyframe = Keyframe(
        kf_id=3,
        frame_id=7,
        stamp_ns=11,
        odom_T_cam=np.eye(4),
        point_ids=np.arange(5),
        uv_left=np.random.default_rng(0).normal(size=(5, 2)),
        uv_right=np.full((5, 2), np.nan),
        points_cam=np.zeros((5, 3)),
        descriptors=np.arange(160, dtype=np.uint8).reshape(5, 32),
    )
    kept = in_own_pages(keyframe)
    assert pickle.dumps(kept) == pickle.dumps(keyframe)
    for name in ("odom_T_cam", "point_ids", "uv_left", "descriptors"):
        array, before = getattr(kept, name), getattr(keyframe, name)
        assert array.dtype == before.dtype
        assert not array.flags.writeable
        assert array.flags.aligned
        assert not np.shares_memory(array, before)
    assert in_own_pages("no array") == "no array"
