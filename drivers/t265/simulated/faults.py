"""Faults of the simulated camera. Frame numbers count since the camera first streamed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from stereo_sfm.errors import one_of

NEVER = -1


@dataclass(frozen=True)
class Faults:
    """The default is a camera without faults."""

    drop_left: frozenset[int] = frozenset()  # frames whose left image is never sent
    drop_right: frozenset[int] = frozenset()
    swapped: frozenset[int] = frozenset()  # frames whose right image is sent first
    right_skew_ns: Mapping[int, int] = field(default_factory=dict[int, int])  # added to the right stamp
    empty: frozenset[int] = frozenset()  # frames whose left image states frameLength 0
    half: Mapping[int, int] = field(default_factory=dict[int, int])  # frame -> bytes after which the left image ends
    split: Mapping[int, int] = field(default_factory=dict[int, int])  # as half, the rest comes as another transfer
    garbage: frozenset[int] = frozenset()  # frames preceded by an invalid transfer
    counter_skips: frozenset[int] = frozenset()  # frames at which the left counter advances by one too many
    stall_at: int = NEVER  # from this frame on no images, until restarted
    stall_survives_restart: bool = False  # only a reset helps
    unplug_at: int = NEVER  # the camera disconnects during this frame
    unplugged_s: float = 0.5  # and comes back after this time, as an unbooted one; negative: never
    busy_replies: int = 0  # number of stream selection commands answered with DEVICE_BUSY
    stale_stopped: bool = False  # DEVICE_STOPPED of an earlier session right after the start
    returns_after_boot: bool = True
    silent_commands: bool = False  # no command is answered
    refuse_open: int = 0  # errno of opening: 13 no permission
    refuse_claim: int = 0  # errno of claiming the interface: 16 busy
    uncalibrated: bool = False
    firmware: tuple[int, int, int, int] = (0, 2, 0, 951)
    speed: int = 4  # of the running camera: 3 is USB 2


def _every(step: int, start: int, count: int = 100_000) -> frozenset[int]:
    return frozenset(range(start, start + step * count, step))


# Presets for `t265:simulated?faults=drops,unplug`.
PRESETS: dict[str, Faults] = {
    "none": Faults(),
    "drops": Faults(drop_left=_every(50, 20), drop_right=_every(70, 45)),
    "swapped": Faults(swapped=_every(3, 1)),
    "half": Faults(half=dict.fromkeys(_every(60, 25), 196_608), split=dict.fromkeys(_every(90, 40), 240_128)),
    "garbage": Faults(garbage=_every(40, 10), empty=_every(55, 30)),
    "skew": Faults(right_skew_ns=dict.fromkeys(_every(80, 35), 2000000)),
    "counters": Faults(counter_skips=_every(120, 33)),
    "stall": Faults(stall_at=60),
    "crash": Faults(stall_at=60, stall_survives_restart=True),
    "unplug": Faults(unplug_at=45, unplugged_s=1.0),
    "gone": Faults(unplug_at=45, unplugged_s=-1.0),
    "busy": Faults(busy_replies=2, stale_stopped=True),
    "usb2": Faults(speed=3),
    "permission": Faults(refuse_open=13),
    "in-use": Faults(refuse_claim=16),
    "uncalibrated": Faults(uncalibrated=True),
}


def preset(names: str) -> Faults:
    """The faults of several presets, separated by commas.

    Raises:
        StereoSfmError: unknown name.
    """
    out, default = Faults(), Faults()
    for name in filter(None, names.split(",")):
        one_of(name, PRESETS, "fault")
        changed = {k: v for k, v in vars(PRESETS[name]).items() if v != getattr(default, k)}
        out = replace(out, **changed)
    return out
