"""Inertial and wheel messages of other programs as the samples of an image."""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import replace
from typing import TypeVar

import numpy as np

from stereo_sfm.drivers.checked_samples import CLOCK_S
from stereo_sfm.drivers.mcap.clock import Clock
from stereo_sfm.drivers.mcap.messages import (
    BAD_MESSAGE,
    IMUS,
    JOINTS,
    VELOCITIES,
    ImuReading,
    WheelReading,
    half_of,
    schema_name,
)
from stereo_sfm.drivers.mcap.recording import Recording
from stereo_sfm.drivers.mcap.topics import ChosenTopics
from stereo_sfm.log.reader import Record
from stereo_sfm.types import ImuSamples, WheelSamples

log = logging.getLogger("stereo_sfm")

Reading = TypeVar("Reading", ImuReading, WheelReading)


def imu_reading(record: Record, topics: ChosenTopics) -> ImuReading | None:
    """What a message measures: of two topics the first one is the gyroscope's, the other one the accelerometer's."""
    with suppress(*BAD_MESSAGE):
        reading = IMUS[schema_name(record)](record.data)
        return reading if len(topics.imu) == 1 else half_of(reading, record.topic == topics.imu[0])
    return None


def wheel_reading(record: Record) -> WheelReading | None:
    """What a message measures of the robot's motion; None for a damaged one."""
    with suppress(*BAD_MESSAGE):
        return (VELOCITIES | JOINTS)[schema_name(record)](record.data)
    return None


def on_the_clock(reader: Recording, topics: ChosenTopics, clock: Clock) -> ChosenTopics:
    """The topics without sensors whose stamps have another clock than the images', with a warning."""
    left_out = [topic for topic in topics.samples if not _has_the_clock(reader, topics, topic, clock)]
    if not left_out:
        return topics
    imu = () if any(topic in left_out for topic in topics.imu) else topics.imu
    return replace(topics, imu=imu, wheel="" if topics.wheel in left_out else topics.wheel)


def _has_the_clock(reader: Recording, topics: ChosenTopics, topic: str, clock: Clock) -> bool:
    for record in reader.messages([topic]):
        reading = wheel_reading(record) if topic == topics.wheel else imu_reading(record, topics)
        if reading is None:
            continue
        stamp_ns = clock.stamp(reading.stamp_ns, record.log_time)
        away_s = abs(stamp_ns - record.log_time - clock.header_minus_log_ns) * 1e-9
        if away_s > CLOCK_S:
            log.warning(
                "%s: the stamps of %s are %.3g s away from the images': another clock, its samples are not used. "
                "Record it with the clock of the cameras",
                reader.path, topic, away_s,
            )  # fmt: skip
        return away_s <= CLOCK_S
    return True


def take_imu(buffer: list[ImuReading], until_ns: int) -> ImuSamples:
    """Remove the samples up to a stamp from the buffer."""
    taken = _up_to(buffer, until_ns)
    values = np.array([s.values for s in taken], float).reshape(-1, 6)
    return ImuSamples(np.array([s.stamp_ns for s in taken], np.int64), values[:, :3].copy(), values[:, 3:].copy())


def take_wheel(buffer: list[WheelReading], until_ns: int, joints: list[str]) -> WheelSamples:
    """Remove the samples up to a stamp from the buffer; speeds of `joints` where those are named."""
    taken = _up_to(buffer, until_ns)
    if joints:
        taken = [s for s in taken if all(name in s.joints for name in joints)]
        speeds = np.array([[s.joints[name] for name in joints] for s in taken], float).reshape(-1, len(joints))
        return WheelSamples.of_wheels(np.array([s.stamp_ns for s in taken], np.int64), speeds)
    linear, angular = (np.array([getattr(s, n) for s in taken], float).reshape(-1, 3) for n in ("linear", "angular"))
    return WheelSamples(np.array([s.stamp_ns for s in taken], np.int64), linear, angular)


def _up_to(buffer: list[Reading], until_ns: int) -> list[Reading]:
    """Remove the samples up to a stamp from the buffer, in their order."""
    taken = sorted((s for s in buffer if s.stamp_ns <= until_ns), key=lambda s: s.stamp_ns)
    buffer[:] = [s for s in buffer if s.stamp_ns > until_ns]
    return taken
