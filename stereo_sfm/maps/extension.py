"""Continue a saved map: the session is mapped as usual, and transformed into the saved map once relocalized."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.calibration.self_calibration import SelfCalibration
from stereo_sfm.calibration.sensor_calibration import SensorCalibration
from stereo_sfm.config import LoopConfig, MapperConfig
from stereo_sfm.geometry import se3
from stereo_sfm.mapping.mapper import Mapper
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.maps.localizer import Localizer
from stereo_sfm.maps.relocalization import Location
from stereo_sfm.timing import NoSpans
from stereo_sfm.types import F64, Keyframe, LoopResult, MapUpdate, no_ids


class Extension(Mapper):
    """A mapper whose updates are in the frame of a saved map once a keyframe was relocalized in it.

    Until then they are in the session's own map frame, which begins at its first keyframe. The session's own map
    (`map`) keeps its frame: `maps.merge` joins the two when the run is saved. The saved map is searched again after a
    correction of the rig, which changes where the session's points are, and in each submap: it joins those that it
    shows. Where the session's map was moved as a whole, by loops or a full bundle adjustment, the relocalized keyframe
    stays in its place. All keyframes and points are in the update of such a step, transformed.
    """

    def __init__(
        self,
        config: MapperConfig,
        rig: Rig,
        spans: NoSpans | None,
        loop_config: LoopConfig,
        localizer: Localizer,
        calibration: SelfCalibration | None = None,
        sensors: SensorCalibration | None = None,
    ) -> None:
        """Args: localizer, in the saved map, without a self-calibration of its own; the others as the mapper's."""
        super().__init__(config, rig, spans, loop_config, calibration, sensors)
        self._localizer = localizer
        self._misplaced = True  # no keyframe of this submap, tracked with the corrected rig, has been relocalized
        self._moved = False  # the session's map, in this step
        self._saved_T_session: F64 | None = None
        self._found: Location | None = None  # of the last relocalized keyframe
        self._submap_id = -1  # that it is of
        self._found_kf: tuple[int, F64] = -1, np.eye(4)  # a living keyframe, and the relocalized one's pose in it

    def step(self, keyframe: Keyframe, loop: LoopResult | None = None) -> MapUpdate:
        """As the mapper's, in the saved map's frame once it is known."""
        update = self._held(super().step(keyframe, loop))
        if update.calibration is not None and update.calibration.applied:
            self._misplaced = True
            self._localizer.relocalize()  # what it expects is of the last time that it was asked
        if self._misplaced or keyframe.submap_id != self._submap_id:
            place, found = self._localizer.step(keyframe), self._localizer.last
            if found is not None and found.found and self._join_submaps(keyframe, found):
                update = dataclasses.replace(update, map_T_odom=self._map_T_odom.copy())
                self._found, self._found_kf = found, (keyframe.kf_id, np.eye(4))
                self._saved_T_session = se3.orthonormalize(place.map_T_odom @ se3.inverse(update.map_T_odom))
                self.found, self._submap_id, self._moved = True, keyframe.submap_id, False
                self._misplaced = not np.array_equal(keyframe.rig_terms, self._terms)
                update = self._with_everything(update)
        return self._in_saved_map(update)

    def finish(self, loops: Sequence[LoopResult]) -> MapUpdate | None:
        """As the mapper's."""
        update = super().finish(loops)
        return None if update is None else self._in_saved_map(self._held(update))

    def place(self, of: MapSnapshot | None = None) -> LoopResult | None:
        """The relocalization, as a loop from a keyframe of the saved map to a live one of the session, or None.

        Ids are those of the respective map.
        """
        saved = self._localizer.saved
        if self._found is None or (of is not None and not _same_ids(saved, of)):
            return None
        where, (living, living_T_kf) = self._found, self._found_kf
        candidate = saved.map_T_kf[int(np.searchsorted(saved.kf_ids, where.kf_id))]
        return LoopResult(
            kf_id=living,
            candidate_kf_id=where.kf_id,
            candidate_T_kf=se3.inverse(candidate) @ where.map_T_cam @ se3.inverse(living_T_kf),
            information=where.information,
            matches=where.pairs,
            inliers=where.inliers,
            score=0.0,
            reason="",
        )

    def _follow_newest(self, before: F64) -> None:
        super()._follow_newest(before)
        self._moved = True

    def _held(self, update: MapUpdate) -> MapUpdate:
        """The update with the relocalized keyframe in its place in the saved map, if the session's map was moved."""
        self._follow_found()
        moved, self._moved = self._moved, False
        if self._found is None or not moved:
            return update
        kf_id, living_T_kf = self._found_kf
        session_T_cam = self.map.keyframes.map_T_kf[self.map.kf_row(kf_id)] @ living_T_kf
        self._saved_T_session = se3.orthonormalize(self._found.map_T_cam @ se3.inverse(session_T_cam))
        return self._with_everything(update)

    def _join_submaps(self, keyframe: Keyframe, found: Location) -> bool:
        """The saved map shows how the newest keyframe lies to the one that was relocalized in another submap.

        Returns:
            False where the session's own map contradicts that: the place only looks alike.
        """
        if self._found is None or keyframe.submap_id == self._submap_id:
            return True
        kf_id, living_T_kf = self._found_kf
        living_T_cam = living_T_kf @ se3.inverse(self._found.map_T_cam) @ found.map_T_cam
        self._close(
            LoopResult(keyframe.kf_id, kf_id, living_T_cam, found.information, no_ids(0, 2), found.inliers, 0.0, "")
        )
        refused, self._refused = bool(self._refused), []  # no result of the loop closer
        if refused:
            self._localizer.relocalize()
        return not refused

    def _follow_found(self) -> None:
        """Where the relocalized keyframe was culled, the keyframe that carries it stands for it."""
        kf_id, living_T_kf = self._found_kf
        if kf_id < 0 or self.map.keyframes.alive[row := self.map.kf_row(kf_id)]:
            return
        table = self.map.keyframes
        self._found_kf = int(table.kf_id[table.reference[row]]), table.reference_T_kf[row] @ living_T_kf

    def _with_everything(self, update: MapUpdate) -> MapUpdate:
        keyframes, points = self.map.living_keyframes(), self.map.living_points()
        points = points[self.map.points.pt_id[points] >= 0]
        return dataclasses.replace(
            update,
            kf_ids=self.map.keyframes.kf_id[keyframes],
            map_T_kf=self.map.keyframes.map_T_kf[keyframes],
            point_ids=self.map.points.pt_id[points],
            points_map=self.map.points.xyz[points],
        )

    def _in_saved_map(self, update: MapUpdate) -> MapUpdate:
        saved_T_session = self._saved_T_session
        if saved_T_session is None:
            return update
        return dataclasses.replace(
            update,
            map_T_kf=saved_T_session @ update.map_T_kf,
            points_map=se3.transform(saved_T_session, update.points_map),
            map_T_odom=saved_T_session @ update.map_T_odom,
            down=saved_T_session[:3, :3] @ update.down,
        )


def _same_ids(a: MapSnapshot, b: MapSnapshot) -> bool:
    """Whether an id names the same keyframe or point in both."""
    return np.array_equal(a.kf_ids, b.kf_ids) and np.array_equal(a.pt_ids, b.pt_ids)
