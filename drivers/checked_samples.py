"""Inertial and wheel samples of any source as the stages take them: ascending, finite, in SI units.

What is doubled, out of order or not a number is taken out, and said in one line; a sensor in other units is left out.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

import numpy as np

from stereo_sfm.types import F64, I64, Bool, ImuSamples, StereoImage, WheelSamples

log = logging.getLogger("stereo_sfm")
S = TypeVar("S", ImuSamples, WheelSamples)

MAX_GYRO, MAX_ACCEL = 50.0, 500.0  # rad/s, m/s^2: above what sensors on robots measure
MAX_SPEED, MAX_WHEEL = 50.0, 1000.0  # m/s, rad/s
JUDGED = 100  # samples until units are judged
CLOCK_S = 10.0  # from the first samples to their image: more is another clock
GAP_S = 1.0  # without samples, between images that come: worth a line


def wrong_imu_units(gyro: F64, accel: F64) -> str:
    """Why samples (N, 3) cannot be in rad/s and m/s^2; "" if they can. NaN rows do not count."""
    rates, forces = (np.linalg.norm(v[np.isfinite(v).all(axis=1)], axis=1) for v in (gyro, accel))
    if (len(rates) and np.percentile(rates, 99) > MAX_GYRO) or (len(forces) and np.percentile(forces, 99) > MAX_ACCEL):
        most = [float(v.max()) if len(v) else 0.0 for v in (rates, forces)]
        return f"rates up to {most[0]:.0f} and forces up to {most[1]:.0f} are not in rad/s and m/s^2 (degrees?)"
    if len(forces) and 0.5 < float(np.median(forces)) < 2:
        return f"a median force of {np.median(forces):.2f} is in g, not in m/s^2"
    return ""


def wrong_wheel_units(linear: F64, speeds: F64) -> str:
    """Why velocities (N, 3) and speeds of wheels (N, W) cannot be in m/s and rad/s; "" if they can."""
    fast = np.linalg.norm(linear[np.isfinite(linear).all(axis=1)], axis=1)
    if len(fast) and np.percentile(fast, 90) > MAX_SPEED:
        return f"velocities up to {fast.max():.0f} are not in m/s (mm/s?)"
    turning = np.abs(speeds[np.isfinite(speeds)])
    if len(turning) and np.percentile(turning, 90) > MAX_WHEEL:
        return f"speeds of wheels up to {turning.max():.0f} are not in rad/s"
    return ""


@dataclass
class _Sensor(Generic[S]):
    """Checks the samples of one sensor, and what is known of them so far."""

    name: str
    kinds: Callable[[S], I64]  # (N,) of each row: which of its measurements it has, 0 for none
    join: Callable[[Sequence[S]], S]
    wrong_units: Callable[[S], str]
    first: list[S] = field(default_factory=list[S])  # by which units are judged
    last_ns: dict[int, int] = field(default_factory=dict[int, int])  # by kind of row
    newest_ns: int | None = None
    said: set[str] = field(default_factory=set[str])
    left_out: bool = False

    def checked(self, samples: S | None) -> S | None:
        """The same object where nothing is wrong; None where the sensor is left out."""
        if samples is None or self.left_out:
            return None
        order = self.ascending(samples.stamp_ns)
        samples = samples if order is None else samples.part(order)
        keep = self.usable(samples.stamp_ns, self.kinds(samples))
        samples = samples if keep.all() else samples.part(np.flatnonzero(keep))
        if sum(map(len, self.first)) < JUDGED:
            self._judge_units(samples)
        return None if self.left_out else samples

    def _judge_units(self, samples: S) -> None:
        self.first.append(samples)
        joined = self.join(self.first)
        why = self.wrong_units(joined) if len(joined) >= JUDGED else ""
        if why:
            self.left_out = True
            self.say("units", f"{why}: they are not used")

    def say(self, what: str, text: str) -> None:
        """One line for each kind of problem."""
        if what not in self.said:
            self.said.add(what)
            log.warning("%s: %s", self.name, text)

    def ascending(self, stamp_ns: I64) -> I64 | None:
        """Rows in the order of time; None where they are already."""
        if not (np.diff(stamp_ns) < 0).any():
            return None
        self.say("order", "samples that are out of order are sorted, as far as they come with one image")
        return np.argsort(stamp_ns, kind="stable")

    def usable(self, stamp_ns: I64, kind: I64) -> Bool:
        """(N,) rows that are of a known kind (0 is none) and later than all before them of that kind."""
        keep = kind > 0
        if not keep.all():
            self.say("nan", "samples that are not numbers are skipped")
        for which in np.unique(kind[keep]).tolist():
            rows = np.flatnonzero(kind == which)
            last = self.last_ns.get(which, np.iinfo(np.int64).min)
            before = np.maximum.accumulate(np.concatenate([[last], stamp_ns[rows]]))
            late = stamp_ns[rows] <= before[:-1]
            keep[rows[late]] = False
            self.last_ns[which] = int(before[-1])
            if late.any():
                self.say("doubled", "samples that are doubled or come too late are skipped")
        return keep

    def note_gap(self, image: StereoImage, samples: S | None) -> None:
        """A line when the sensor falls silent, or has another clock."""
        if self.left_out or (samples is None and self.newest_ns is None):
            return
        came, first = samples is not None and len(samples) > 0, self.newest_ns is None
        if samples is not None and came:
            self.newest_ns = int(samples.stamp_ns[-1])
        elif self.newest_ns is None:
            self.newest_ns = image.stamp_ns  # none came yet
        away_s = abs(image.stamp_ns - (self.newest_ns or 0)) * 1e-9
        if came and first and away_s > CLOCK_S:
            self.say(
                "clock", f"their stamps are {away_s:.3g} s away from the images': another clock, they are not used"
            )
        elif away_s > GAP_S and "clock" not in self.said:
            self.say("gap", f"no samples for more than {GAP_S:g} s: the run goes on without them")


def _imu_kinds(samples: ImuSamples) -> I64:
    turned, pushed = np.isfinite(samples.gyro).all(axis=1), np.isfinite(samples.accel).all(axis=1)
    return np.where(turned, 1, np.where(pushed, 2, 0))


def _wheel_kinds(samples: WheelSamples) -> I64:
    moved = np.isfinite(samples.linear).all(axis=1)
    known = np.isfinite(samples.speeds).all(axis=1) if samples.speeds.size else np.zeros(len(samples), bool)
    return np.where(moved | known, 1, 0)


class SampleChecker:
    """Checks the samples of successive images."""

    def __init__(self) -> None:
        self._imu = _Sensor(
            "inertial samples", _imu_kinds, ImuSamples.joined, lambda s: wrong_imu_units(s.gyro, s.accel)
        )
        self._wheel = _Sensor(
            "wheel samples", _wheel_kinds, WheelSamples.joined, lambda s: wrong_wheel_units(s.linear, s.speeds)
        )

    def checked(self, image: StereoImage) -> StereoImage:
        """The image with samples that the stages can use: the same object where nothing is wrong."""
        imu, wheel = self._imu.checked(image.imu), self._wheel.checked(image.wheel)
        self._imu.note_gap(image, imu)
        self._wheel.note_gap(image, wheel)
        same = imu is image.imu and wheel is image.wheel
        return image if same else replace(image, imu=imu, wheel=wheel)


def checked_samples(images: Iterable[StereoImage]) -> Iterator[StereoImage]:
    """The images with samples that the stages can use; every kind of problem is said once."""
    checker = SampleChecker()
    return (checker.checked(image) for image in images)
