"""Detection of the image, calibration and ground-truth topics of a foreign recording by schema and name."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import PurePosixPath

from stereo_sfm.calib.side_names import side_pairs, words_of
from stereo_sfm.drivers.mcap.messages import (
    CAMERAS,
    ENCODINGS,
    IMAGES,
    IMUS,
    JOINTS,
    POSES,
    TRANSFORMS,
    VELOCITIES,
)
from stereo_sfm.drivers.mcap.recording import Recording
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.log.reader import TopicInfo

log = logging.getLogger("stereo_sfm")

_DEPTH = {"depth", "depthmap", "disparity"}  # words of names
_REGISTERED = {"registered", "aligned", "to"}  # of depth as the colour camera sees it: /depth_to_rgb
_GYRO, _ACCEL = ("gyro", "gyroscope"), ("accel", "acc", "accelerometer")
_TRUTH = ("ground_truth", "groundtruth", "mocap", "vicon")


@dataclass(frozen=True)
class ChosenTopics:
    """Topic names; "" for missing ones."""

    left: str
    right: str
    depth: str
    truth: str
    imu: tuple[str, ...]  # one, or the gyroscope's and the accelerometer's
    wheel: str  # velocities of the robot, or speeds of its joints
    cameras: tuple[str, ...]
    transforms: tuple[str, ...]

    @property
    def other(self) -> str:
        """Of the images that belong to the left ones."""
        return self.right or self.depth

    @property
    def images(self) -> list[str]:
        """The left topic, and the other one if there is any."""
        return [topic for topic in (self.left, self.other) if topic]

    @property
    def samples(self) -> list[str]:
        """Of sensors beside the cameras."""
        return [*self.imu, *([self.wheel] if self.wheel else [])]


def choose_topics(reader: Recording, left: str = "", right: str = "", depth: str = "", wheel: str = "") -> ChosenTopics:
    """Find the image topics.

    Args:
        reader: the open recording.
        left: image topic given by the user, "" to find it. right, depth, wheel: likewise.

    Raises:
        StereoSfmError: no images, an unknown topic, or more than two images with ambiguous names.
    """
    rows = [t for t in reader.topics if t.topic and t.encoding in ENCODINGS]
    image_topics = [t.topic for t in rows if t.schema in IMAGES]
    if not image_topics:
        raise StereoSfmError(f"{reader.path} contains no images ({_content(reader.topics)})")
    for name in (left, right, depth):
        if name and name not in image_topics:
            raise StereoSfmError(f"{reader.path} has no image topic {name} (there are: {', '.join(image_topics)})")
    cameras = tuple(t.topic for t in rows if t.schema in CAMERAS)
    seen = [t for t in image_topics if not _is_depth(t)]
    candidates = [t for t in seen if not any(t.startswith(f"{other}/") for other in seen)]  # one image's transports
    if not left:
        left, found = _pair(str(reader.path), candidates or image_topics, cameras)
        right = right or ("" if depth else found)
    if not right and not depth:
        depth = _depth_topic([t for t in image_topics if _is_depth(t) and t != left])
    return ChosenTopics(
        left,
        right,
        "" if right else depth,
        next((t.topic for t in rows if t.schema in POSES and _is_truth(t.topic)), ""),
        _imu_topics([t.topic for t in rows if t.schema in IMUS]),
        _wheel_topic(str(reader.path), rows, wheel),
        cameras,
        tuple(t.topic for t in rows if t.schema in TRANSFORMS),
    )


def _imu_topics(topics: list[str]) -> tuple[str, ...]:
    """The first IMU; both topics of one whose gyroscope and accelerometer are separate, the gyroscope's first."""
    both = [t for t in topics if not {*_GYRO, *_ACCEL} & {*words_of(t)}]
    for gyro in topics:
        around = [word for word in words_of(gyro) if word not in _GYRO]
        if len(around) == len(words_of(gyro)):
            continue
        for accel in topics:
            words = words_of(accel)
            if accel != gyro and [w for w in words if w not in _ACCEL] == around and {*_ACCEL} & {*words}:
                return gyro, accel
    return tuple((both or topics)[:1])


def _wheel_topic(name: str, rows: list[TopicInfo], chosen: str) -> str:
    """The topic that the user names, else one of velocities whose name says that it is of the wheels."""
    if chosen:
        known = [t.topic for t in rows if t.schema in VELOCITIES | JOINTS]
        if chosen not in known:
            raise StereoSfmError(f"{name} has no wheel odometry {chosen} (there is: {', '.join(known) or 'none'})")
        return chosen
    names = [t.topic for t in rows if t.schema in VELOCITIES and not _is_truth(t.topic)]
    return next((t for t in names if any(w.startswith("wheel") for w in words_of(t)) or t.endswith("/odom")), "")


def camera_topic(image: str, cameras: tuple[str, ...]) -> str:
    """The calibration of an image topic: the topic with the longest common path, "" if there is none."""
    best = max(cameras, key=lambda c: _shared(image, c), default="")
    return best if best and _shared(image, best) else ""


def is_rectified(topic: str) -> bool:
    """Whether an image topic has rectified images, by its name."""
    return any(word == "rect" or word.startswith("rectif") for word in words_of(topic))


def _content(topics: list[TopicInfo]) -> str:
    if not topics:
        return "no messages at all"
    return "its topics: " + ", ".join(f"{t.topic} {t.schema or t.encoding}" for t in topics[:12])


def _is_depth(topic: str) -> bool:
    return not _DEPTH.isdisjoint(words_of(topic))


def _depth_topic(topics: list[str]) -> str:
    """The first, of those that another camera's pixels were computed for if there are any; "" of none."""
    return min(topics, key=lambda t: _REGISTERED.isdisjoint(words_of(t)), default="")


def _is_truth(topic: str) -> bool:
    return any(word in topic.lower() for word in _TRUTH)


def _shared(a: str, b: str) -> int:
    """Leading path parts that two topics share."""
    count = 0
    for x, y in zip(PurePosixPath(a).parts[1:], PurePosixPath(b).parts[1:], strict=False):
        if x != y:
            break
        count += 1
    return count


def _pair(name: str, candidates: list[str], cameras: tuple[str, ...]) -> tuple[str, str]:
    pairs = side_pairs(candidates)
    if pairs:
        order = {pair: i for i, pair in reversed(list(enumerate(pairs)))}
        return min(order, key=lambda p: (not camera_topic(p[0], cameras), is_rectified(p[0]), len(p[0]), order[p]))
    if len(candidates) == 1:
        return candidates[0], ""
    if len(candidates) == 2:
        log.warning(
            "%s: assuming %s is the left camera and %s the right one: choose with '?left=TOPIC&right=TOPIC'",
            name, *sorted(candidates),
        )  # fmt: skip
        return sorted(candidates)[0], sorted(candidates)[1]
    raise StereoSfmError(
        f"{name} has {len(candidates)} image topics with ambiguous names: "
        f"choose with '{name}?left=TOPIC&right=TOPIC' ({', '.join(candidates)})"
    )
