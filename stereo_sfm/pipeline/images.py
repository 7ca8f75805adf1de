"""Images between processes: a ring of slots in shared memory. Messages carry the slot, never the pixels.

The capture stage owns the slots. A slot is free again when all its readers have returned it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import os
import secrets
import time
from dataclasses import dataclass
from multiprocessing import shared_memory
from pathlib import Path

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import F32, U8, StereoImage

SHARED = Path("/dev/shm")  # where Linux keeps shared memory
PREFIX = "stereo_sfm_ring_"
MIN_AGE_S = 2.0  # a newer ring may not be locked by its owner yet
_NO_PIXELS = np.zeros((0, 0), np.uint8)


@dataclass(frozen=True)
class ImageLayout:
    """Layout of the images of a slot; shapes are (H, W)."""

    left: tuple[int, int]
    right: tuple[int, int] | None
    depth: tuple[int, int] | None

    @staticmethod
    def of(rig: Rig) -> ImageLayout:
        """What this rig's images need."""
        left, second = (rig.left.height, rig.left.width), rig.second_camera
        right = None if second is None else (second.height, second.width)
        return ImageLayout(left, right, left if rig.depth else None)

    @property
    def size(self) -> int:
        """Bytes of one slot."""
        return _area(self.left) + _area(self.right) + 4 * _area(self.depth)


def _area(shape: tuple[int, int] | None) -> int:
    return 0 if shape is None else shape[0] * shape[1]


@dataclass(frozen=True, eq=False)
class SlotImage:
    """A StereoImage whose pixels are in a slot, with the time it was taken from the driver (for latency)."""

    slot: int
    image: StereoImage  # without pixels
    has_right: bool
    has_depth: bool
    captured_s: float  # monotonic clock
    encoded: tuple[bytes, bytes | None] | None = None  # JPEG bytes whose decoded pixels the slot holds
    logged: bool = True  # the log (main, where there is none) reads and returns the slot


class ImageRing:
    """Slots of image pairs in one block of shared memory."""

    def __init__(self, layout: ImageLayout, slots: int, name: str | None = None) -> None:
        """Make a new block, or attach to the one called `name`."""
        self.layout, self.slots = layout, slots
        self._owner = name is None
        self._memory = self._make() if name is None else shared_memory.SharedMemory(name)

    def _make(self) -> shared_memory.SharedMemory:
        """A block that is locked for the life of this process, with all its memory allocated.

        Raises:
            StereoSfmError: there is not enough shared memory.
        """
        remove_abandoned()
        size = max(self.layout.size * self.slots, 1)
        try:
            memory = shared_memory.SharedMemory(PREFIX + secrets.token_hex(8), create=True, size=size)
            descriptor: int = memory._fd  # pyright: ignore[reportAttributeAccessIssue]
            with contextlib.suppress(OSError):  # where shared memory has no locks, none is checked
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            _allocate(memory, descriptor, size)
        except OSError as error:
            raise StereoSfmError(
                f"{SHARED} has no room for {self.slots} images ({size / 1e6:.0f} MB): {error.strerror}; make it larger "
                "(docker: --shm-size), use --set pipeline.ring_slots=2, or --inline"
            ) from None
        return memory

    @property
    def name(self) -> str:
        """For other processes to attach."""
        return self._memory.name

    def _arrays(self, slot: int) -> tuple[U8, U8 | None, F32 | None]:
        buffer, at = self._memory.buf, slot * self.layout.size
        left = np.ndarray(self.layout.left, np.uint8, buffer, at)
        at += _area(self.layout.left)
        right = None if self.layout.right is None else np.ndarray(self.layout.right, np.uint8, buffer, at)
        at += _area(self.layout.right)
        depth = None if self.layout.depth is None else np.ndarray(self.layout.depth, np.dtype("<f4"), buffer, at)
        return left, right, depth

    def write(
        self,
        slot: int,
        image: StereoImage,
        captured_s: float,
        encoded: tuple[bytes, bytes | None] | None = None,
        logged: bool = True,
    ) -> SlotImage:
        """Put the pixels into a slot."""
        left, right, depth = self._arrays(slot)
        left[...] = image.left
        if right is not None and image.right is not None:
            right[...] = image.right
        if depth is not None and image.depth is not None:
            depth[...] = image.depth
        bare = dataclasses.replace(image, left=_NO_PIXELS, right=None, depth=None)
        return SlotImage(slot, bare, image.right is not None, image.depth is not None, captured_s, encoded, logged)

    def read(self, message: SlotImage) -> StereoImage:
        """The image with its own copy of the pixels, so that the slot can be returned at once."""
        left, right, depth = self._arrays(message.slot)
        return dataclasses.replace(
            message.image,
            left=left.copy(),
            right=right.copy() if right is not None and message.has_right else None,
            depth=depth.copy() if depth is not None and message.has_depth else None,
        )

    def close(self) -> None:
        """Detach; the maker also frees the memory."""
        self._memory.close()
        if self._owner:
            self._memory.unlink()


def _allocate(memory: shared_memory.SharedMemory, descriptor: int, size: int) -> None:
    """Allocate the pages now: a file system that fills up later would end the run with SIGBUS."""
    if not hasattr(os, "posix_fallocate"):
        return
    try:
        os.posix_fallocate(descriptor, 0, size)
    except OSError:
        memory.close()
        memory.unlink()
        raise


def remove_abandoned(folder: Path = SHARED, min_age_s: float = MIN_AGE_S) -> None:
    """Remove the rings of runs that were killed with all their processes: their lock is free."""
    for path in sorted(folder.glob(f"{PREFIX}*")):
        with contextlib.suppress(OSError):  # of another user, or in use
            if time.time() - path.stat().st_mtime < min_age_s:
                continue
            descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.unlink()
            finally:
                os.close(descriptor)
