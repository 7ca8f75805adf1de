"""`t265:simulated`: the complete driver on a simulated camera, including firmware."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

import numpy as np

from stereo_sfm.drivers.live.source import Patience, with_rig
from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.drivers.t265.acquire import Access
from stereo_sfm.drivers.t265.camera import Settings
from stereo_sfm.drivers.t265.firmware import SIZE, Firmware, verified
from stereo_sfm.drivers.t265.link import Timing
from stereo_sfm.drivers.t265.simulated.bus import SimulatedBus
from stereo_sfm.drivers.t265.simulated.camera import SimulatedCamera
from stereo_sfm.drivers.t265.simulated.content import room_content, source_content
from stereo_sfm.drivers.t265.simulated.faults import preset
from stereo_sfm.drivers.t265.source import T265Source, settings_of
from stereo_sfm.types import I64, Trajectory

if TYPE_CHECKING:
    from stereo_sfm.drivers.t265 import T265Options

# The simulated camera needs short timeouts only.
FAST = Timing(busy_wait_s=0.05, boot_s=3.0, boot_poll_s=0.02, settle_s=0.02)


def simulated_firmware() -> bytes:
    """A file of the right size that only the simulated camera accepts."""
    return b"MA2x" + bytes(SIZE - 4)


def checked_firmware() -> Firmware:
    """The simulated firmware, verified like a real one."""
    data = simulated_firmware()
    return verified(data, frozenset({hashlib.sha1(data).hexdigest()}))


class SimulatedT265Source(T265Source):
    """As the real source, with ground truth afterwards."""

    def __init__(
        self, camera: SimulatedCamera, access: Access, settings: Settings, patience: Patience, queue: int = 30
    ) -> None:
        self.camera = camera
        super().__init__(access, settings, patience, queue, name="t265:simulated")

    def frame_shown(self, stamp_ns: int) -> int:
        """The frame number, since the camera first streamed, of an image with this stamp."""
        return round(self.camera.seconds_of(stamp_ns - self._time.stamp(0)) * m.FRAME_RATE)

    def truth(self, stamps: I64) -> Trajectory:
        """True poses at (N,) stamps of received images."""
        stamps = np.array(stamps, np.int64)
        seconds = np.array([self.camera.seconds_of(int(s) - self._time.stamp(0)) for s in stamps])
        return Trajectory(stamps, self.camera.content.pose(seconds))


def open_simulated(options: T265Options) -> SimulatedT265Source:
    """A simulated camera with the scene of the options."""
    content = (
        room_content(options.frames, options.seed)
        if options.images == "room"
        else source_content(options.images, options.frames)
    )
    camera = SimulatedCamera(content, preset(options.faults), options.paced)
    access = Access(SimulatedBus([camera]), "", checked_firmware, options.allow_slow, FAST)
    source = SimulatedT265Source(camera, access, settings_of(options), Patience(reconnect_s=5.0), options.queue)
    return with_rig(source, options.rig)
