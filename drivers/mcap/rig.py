"""The rig of a foreign recording: lens models from its calibration messages, extrinsics from transforms or from P."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager, suppress
from itertools import permutations

import numpy as np

from stereo_sfm.calib.formats.camera_info import CameraInfo, extrinsics
from stereo_sfm.calib.lens_doubts import believable
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.mcap.messages import Transform
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.types import F64

log = logging.getLogger("stereo_sfm")

_OTHERWISE = "give a calibration with --rig FILE"
_DRAWN = 1e-6  # radians between two cameras below which nothing measured them
_SAME_LENGTH = 0.02  # share by which P's baseline and that of the transforms may differ, both being rounded
Warn = Callable[..., None]  # as `Logger.warning`
_PARALLEL_DEG = 45.0  # cameras of a pair see the same; axes of a camera's body are turned by 90 from its optical ones


@contextmanager
def _said_of(topic: str) -> Generator[None]:
    """A problem of a calibration message as one line that names its topic."""
    try:
        yield
    except (ValueError, StereoSfmError) as error:
        raise StereoSfmError(f"the calibration on {topic} cannot be used: {error}: {_OTHERWISE}") from None


def camera_of(info: CameraInfo, topic: str, rectified: bool) -> Camera:
    """Lens model of one camera.

    Args:
        info: its calibration message.
        topic: where it comes from, for the error.
        rectified: the images are rectified, so that the pinhole of P holds.

    Raises:
        StereoSfmError: uncalibrated, damaged, or an unsupported lens model.
    """
    with _said_of(topic):
        return believable([info.camera(rectified)], topic)[0]


def stereo_rig(
    left: CameraInfo,
    right: CameraInfo,
    topics: tuple[str, str],
    rectified: bool,
    transforms: Iterable[Transform],
    warn: Warn = log.warning,
) -> Rig:
    """The rig of both cameras with the extrinsics; what is odd about it goes to `warn`.

    The transforms between the cameras' frames go before R and P of raw images, unless they are a drawing's (parallel)
    and R was measured, and after P of rectified ones.

    Raises:
        StereoSfmError: a damaged message, or extrinsics neither in the transforms nor in P.
    """
    cameras: list[Camera] = []
    for info, topic in zip((left, right), topics, strict=True):
        with _said_of(topic):
            cameras.append(info.camera(rectified))
    cameras = believable(cameras, topics[0], warn)
    with _said_of(topics[1]):
        stated = extrinsics(left, right, rectified)
    known = list(transforms)
    measured = chain(known, left.frame, right.frame)
    if measured is not None and stated is not None and not rectified and _nominal(measured, stated, left, right):
        warn("%s and %s: their transform says parallel, R and P say how they were calibrated, which counts", *topics)
        measured = None
    if measured is None and stated is None:
        raise StereoSfmError(_missing(left, right, topics, known))
    if stated is not None and (measured is None or rectified):
        distorted = not rectified and any(camera.distortion for camera in cameras)
        measured = _with_rotation(left, right, topics, stated, known, warn) if distorted else stated
    assert measured is not None
    with _said_of(topics[1]):
        return Rig(cameras[0], cameras[1], measured)


def other_reading(
    left: CameraInfo, right: CameraInfo, topics: tuple[str, str], rectified: bool, transforms: Iterable[Transform]
) -> tuple[str, Rig] | None:
    """What the messages say of images that are, against their topics' names, rectified or not; None if that is the
    same, or cannot be. With it goes what that would mean, for a message."""
    if rectified and not any((*left.coefficients, *right.coefficients)):
        return None
    text = "are not rectified, although their topics' names say so" if rectified else "are rectified already"
    with suppress(StereoSfmError):
        return f"the images {text}", stereo_rig(left, right, topics, not rectified, transforms, lambda *_: None)
    return None


def _missing(left: CameraInfo, right: CameraInfo, topics: tuple[str, str], transforms: list[Transform]) -> str:
    frames = sorted({name for t in transforms for name in (t.parent, t.child)} - {""})
    there = f"the transforms are of {', '.join(frames[:12])}" if frames else "there are no transforms"
    if left.frame == right.frame:
        return (
            f"both cameras name the frame '{left.frame}', so that no transform tells where they are, and P of "
            f"{topics[1]} has no baseline ({there}): {_OTHERWISE}"
        )
    return f"no transform from '{left.frame}' to '{right.frame}' ({there}) and no baseline in {topics[1]}: {_OTHERWISE}"


def _nominal(transform: F64, stated: F64, left: CameraInfo, right: CameraInfo) -> bool:
    """Whether a transform is of a robot's drawing, while R and P are of a calibration: lenses are never parallel."""
    measured = (left.checked().r != np.eye(3)).any() or (right.checked().r != np.eye(3)).any()
    return bool(measured and se3.extent(transform)[1] < _DRAWN < se3.extent(stated)[1])


def _with_rotation(
    left: CameraInfo, right: CameraInfo, topics: tuple[str, str], stated: F64, transforms: list[Transform], warn: Warn
) -> F64:
    """What R and P state of raw images; with no rotation in R, that of two other frames as far apart as P says.

    A calibration of two real lenses has a rotation: an R that is exactly the identity was never filled in.
    """
    if (left.checked().r != np.eye(3)).any() or (right.checked().r != np.eye(3)).any():
        return stated
    found = _pairs_apart(transforms, float(np.linalg.norm(stated[:3, 3])))
    if len(found) == 1:
        (names, transform), *_ = found.items()
        warn("%s and %s have no rotation in R: it is taken from the transform of %s to %s", *topics, *names)
        return transform
    warn("%s and %s have no rotation in R, and no transform tells it: 'stereo-sfm check-calib' measures it", *topics)
    return stated


def _pairs_apart(transforms: list[Transform], baseline: float) -> dict[tuple[str, str], F64]:
    """Pairs of frames of which the second is a camera to the right of the first, so far away."""
    frames = sorted({name for t in transforms for name in (t.parent, t.child)})
    out: dict[tuple[str, str], F64] = {}
    for a, b in permutations(frames, 2):
        step = chain(transforms, a, b)
        if step is None or step[0, 3] < np.cos(np.deg2rad(_PARALLEL_DEG)) * baseline:
            continue
        apart, turned = se3.extent(step)
        if abs(apart - baseline) < _SAME_LENGTH * baseline and turned < np.deg2rad(_PARALLEL_DEG):
            out[a, b] = step
    return out


def chain(transforms: list[Transform], parent: str, child: str) -> F64 | None:
    """parent_T_child through a tree of transforms (shortest path), None when they are not connected or the same."""
    edges: dict[str, dict[str, F64]] = {}
    parent, child = parent.lstrip("/"), child.lstrip("/")  # as ROS 1 takes them
    for t in transforms:
        above, below = t.parent.lstrip("/"), t.child.lstrip("/")
        edges.setdefault(above, {}).setdefault(below, t.matrix)
        edges.setdefault(below, {}).setdefault(above, se3.inverse(t.matrix))
    found: dict[str, F64] = {parent: np.eye(4)}
    queue = deque([parent])
    while queue:
        here = queue.popleft()
        for there, matrix in edges.get(here, {}).items():
            if there not in found:
                found[there] = found[here] @ matrix
                queue.append(there)
    return found.get(child) if parent != child else None
