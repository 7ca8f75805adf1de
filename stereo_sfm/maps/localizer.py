"""Localization only: replaces the mapper by a stage that localizes the odometry frame in a finished map."""

from __future__ import annotations

import numpy as np

from stereo_sfm.calib.choice import with_terms
from stereo_sfm.calibration.self_calibration import SelfCalibration
from stereo_sfm.geometry import se3
from stereo_sfm.mapping.level import mean_down
from stereo_sfm.mapping.protocol import AnyMapper
from stereo_sfm.maps.relocalization import Location, Relocalizer, not_found
from stereo_sfm.types import F64, RIG_TERMS, CalibrationUpdate, Keyframe, LoopResult, MapUpdate

LOST_AFTER = 5  # keyframes not found near the prediction, as beside people, before the whole map is searched


class Localizer(AnyMapper):
    """For each keyframe, a `MapUpdate` that changes only `map_T_odom`, with the direction of gravity.

    The first location needs no prediction; if it has few inliers, a second keyframe must confirm it. Later keyframes
    are searched around the prediction; after some failures, or when tracking restarted in another submap, the whole
    map is searched again. `found` is False until the first location.
    Keyframes before the first location of their submap are placed with it, by odometry. Gravity is that of the saved
    map once the camera is located in it; before, and in a map without, what the newest keyframe measured.
    """

    def __init__(self, relocalizer: Relocalizer, calibration: SelfCalibration | None = None) -> None:
        """Begin before the first keyframe. Args: calibration, estimates corrections of the rig; None: the rig stays."""
        super().__init__(relocalizer.camera)
        self._relocalizer, self.saved = relocalizer, relocalizer.map
        self._calibration = calibration
        self._tracked_terms: F64 = np.zeros(RIG_TERMS)  # of the correction with which the keyframes were tracked
        self._saved_down = mean_down(self.saved.map_T_kf, self.saved.down, self.saved.down_sigma)
        self._map_T_odom: F64 = np.eye(4)
        self._version = 0
        self._submap = -1
        self._failures = 0
        self._unconfirmed: F64 | None = None  # map_T_odom by the newest keyframe, if it has few inliers
        self._waiting: list[tuple[int, F64]] | None = []  # keyframes of this submap without a location; None: located
        self.last: Location | None = None  # result of the newest keyframe

    def step(self, keyframe: Keyframe, loop: LoopResult | None = None) -> MapUpdate:
        """Localize a keyframe in the map; `loop` belongs to the mapper's signature and is unused."""
        self._version += 1
        revised = self._revise(keyframe)
        if keyframe.submap_id != self._submap:
            self._submap, self._failures, self._waiting = keyframe.submap_id, LOST_AFTER, []
            self._unconfirmed = None
        self.last = self._locate(keyframe) if keyframe.described else not_found("not_described")
        if self.last.found:
            self._map_T_odom = se3.orthonormalize(self.last.map_T_cam @ se3.inverse(keyframe.odom_T_cam))
            self.found, self._failures = True, 0
        elif keyframe.described:
            self._failures += 1
        placed = self._placed(keyframe)
        return MapUpdate(
            version=self._version,
            kf_id=keyframe.kf_id,
            kf_ids=np.array([kf_id for kf_id, _ in placed], np.int64),
            map_T_kf=np.array([self._map_T_odom @ odom_T_cam for _, odom_T_cam in placed]).reshape(-1, 4, 4),
            map_T_odom=self._map_T_odom.copy(),
            calibration=revised,
            down=self._down(keyframe),
        )

    def _revise(self, keyframe: Keyframe) -> CalibrationUpdate | None:
        """Correct the rig where the keyframes show that it is wrong."""
        if not np.array_equal(keyframe.rig_terms, self._tracked_terms):  # the tracker's rig was corrected
            self._tracked_terms = keyframe.rig_terms
            self._relocalizer.use(with_terms(self._source_rig, self._tracked_terms))
        revision = None if self._calibration is None else self._calibration.add(keyframe)
        if self._calibration is None or revision is None:
            return None
        if self._calibration.applies:
            self._terms, self.rig = revision.terms, with_terms(self._source_rig, revision.terms)
        where = self._version, keyframe.kf_id, keyframe.stamp_ns
        return revision.message(*where, self._calibration.applies)

    def relocalize(self) -> None:
        """Do not trust the prediction: search the whole map with the next keyframe."""
        self._failures = LOST_AFTER

    def _down(self, keyframe: Keyframe) -> F64:
        """(3,) direction of gravity in the map, zero where it is not known."""
        if self.found and self._saved_down.any():
            return self._saved_down
        return self._map_T_odom[:3, :3] @ keyframe.odom_T_cam[:3, :3] @ keyframe.down

    def _placed(self, keyframe: Keyframe) -> list[tuple[int, F64]]:
        """The keyframes (id, odom_T_cam) whose locations become known with this one."""
        newest = keyframe.kf_id, keyframe.odom_T_cam
        if self._waiting is None:
            return [newest]
        waiting = [*self._waiting, newest]
        found = self.last is not None and self.last.found
        self._waiting = None if found else waiting
        return waiting if found else []

    def _locate(self, keyframe: Keyframe) -> Location:
        if self.found and self._failures < LOST_AFTER:
            guess = self._map_T_odom @ keyframe.odom_T_cam
            near = self._relocalizer.locate_near(keyframe, guess)
            if not near.found or self._within_gate(guess, near):
                return near
        place = self._relocalizer.locate(keyframe)
        before, self._unconfirmed = self._unconfirmed, None
        if not place.found or place.confident:
            return place
        if before is not None and self._within_gate(before @ keyframe.odom_T_cam, place):
            return place
        self._unconfirmed = se3.orthonormalize(place.map_T_cam @ se3.inverse(keyframe.odom_T_cam))
        return not_found("not_confirmed_yet", place.inliers)

    def _within_gate(self, guess: F64, place: Location) -> bool:
        return se3.within(guess, place.map_T_cam, *self._relocalizer.config.gate())
