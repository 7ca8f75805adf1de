"""Mapping between the camera's clock and the host's, and one time line over restarts of the camera. Pure."""

from __future__ import annotations

GOOD_HALF_TRIP_NS = 250_000  # librealsense accepts a reading whose half round trip is shorter
_SLOWEST = 10_000  # ns in which a camera's clock loses less than one: 100 ppm, some times what quartz does


class ClockMap:
    """host = camera + offset, from readings of the camera's clock between two readings of ours."""

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self._arrived_ns = 0
        self.uncertainty_ns = 0

    def add(self, host_before_ns: int, camera_ns: int, host_after_ns: int) -> bool:
        """Take a reading; the first is always kept, later ones when their round trip was short.

        Returns:
            Whether it was accurate enough to stop.
        """
        half = (host_after_ns - host_before_ns) // 2
        good = half < GOOD_HALF_TRIP_NS
        if good or self._offset_ns is None or half < self.uncertainty_ns:
            self._offset_ns, self.uncertainty_ns = host_before_ns + half - camera_ns, half
        return good

    def add_arrival(self, host_ns: int, camera_ns: int) -> None:
        """Take the arrival of an image, where nothing better tells the time: those that are least late count."""
        offset = host_ns - camera_ns
        if self._offset_ns is not None:
            offset = min(offset, self._offset_ns + (host_ns - self._arrived_ns) // _SLOWEST)
        self._offset_ns, self._arrived_ns = offset, host_ns

    @property
    def known(self) -> bool:
        """Whether there was any reading."""
        return self._offset_ns is not None

    def to_host(self, camera_ns: int) -> int:
        """Camera clock -> this computer's monotonic clock."""
        return camera_ns + (self._offset_ns or 0)

    def to_camera(self, host_ns: int) -> int:
        """This computer's monotonic clock -> camera clock."""
        return host_ns - (self._offset_ns or 0)


class TimeLine:
    """Stamps of the first segment's camera clock, continued when the camera restarts with a new clock.

    Inside a segment differences of stamps are differences of the camera's clock exactly. Between segments they are
    as accurate as two clock readings, the last of the old segment and the first of the new one.
    """

    def __init__(self) -> None:
        self._clock: ClockMap | None = None
        self._shift = 0
        self._last = -1

    def begin_segment(self, clock: ClockMap) -> None:
        """The camera has (re)started and `clock` maps its new clock."""
        if self._clock is not None:
            self._shift += clock.to_host(0) - self._clock.to_host(0)
        self._clock = clock

    def stamp(self, camera_ns: int) -> int:
        """Camera clock of this segment -> the one time line."""
        return camera_ns + self._shift

    def frame_stamp(self, camera_ns: int) -> int:
        """As `stamp`, but always after the stamp of the last frame."""
        self._last = max(self.stamp(camera_ns), self._last + 1)
        return self._last

    @property
    def last(self) -> int:
        """Stamp of the last frame, -1 before any."""
        return self._last
