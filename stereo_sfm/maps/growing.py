"""A saved map that a running session is joined with as it goes on: what was joined stays joined."""

from __future__ import annotations

import copy
import dataclasses
from collections import deque

import numpy as np

from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.loop.closer import LoopCloser
from stereo_sfm.loop.vocabulary import Vocabulary
from stereo_sfm.mapping import window
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.maps.cameras import difference, unified
from stereo_sfm.maps.joining import Joining
from stereo_sfm.maps.saved_map import SavedMap
from stereo_sfm.maps.update import in_frame_of, without_superseded
from stereo_sfm.types import F64, I64, Keyframe, LoopResult

_FRACTION = np.uint64(0x9E3779B97F4A7C15)  # of the golden ratio: it scatters equal differences


class GrowingMap:
    """A saved map and the part of a session that was joined with it.

    `take` enters what the session has mapped since the last time: new keyframes follow the newest one that was joined,
    points and keyframes that it culled go. `work` then looks for loops of one new keyframe; with a loop the bundle
    around it is adjusted. `saved` is the joined map at any time. Keyframes that were joined stay where loops and
    adjustments of this map put them: the session finds the same loops, and they must not be applied twice.
    """

    def __init__(self, base: SavedMap, vocabulary: Vocabulary, config: Config) -> None:
        """Args: base, the saved map that the session began with. vocabulary, of the loop search. config, of loops and
        mapping."""
        self._base, self._vocabulary, self._config = base, vocabulary, config
        s = base.snapshot
        self._first_kf, self._first_submap = int(s.kf_ids.max()) + 1, int(s.submap_ids.max()) + 1
        self._begin()

    def _begin(self) -> None:
        """Without a session."""
        self._joining = Joining(self._base, self._config.loop, self._config.mapper)
        self._map, self._rigs = self._joining.map, self._joining.rigs
        self._next_pt = int(self._base.snapshot.pt_ids.max()) + 1
        self._keys, self._key_pt = np.zeros(0, np.uint64), np.zeros(0, np.int64)  # sightings: sorted, and their points
        self._odometry: dict[int, F64] = {}  # keyframe of the session -> its pose, continuous in a submap
        self._part: SavedMap | None = None
        self._closer: LoopCloser | None = None
        self._queue: deque[Keyframe] = deque()  # not searched yet
        self._culled: set[int] = set()  # by the session, of which the search may still have some
        self._bent = False  # by loops since the whole map was adjusted

    def take(self, part: SavedMap, place: LoopResult | None) -> None:
        """Enter the session's own map as it is now.

        Args: part, of `unfinished.save_session`, as is place, a loop from the saved map to the session.

        Raises:
            StereoSfmError: the session was not found in the saved map yet, or has another kind of camera.
        """
        if part.rig.stereo != self._base.rig.stereo:
            raise StereoSfmError(f"these maps cannot be merged: {difference(self._base.rig, part.rig)}")
        before = self._part
        if before is not None and unified([before.rig, part.rig])[1] is not before.rig:
            self._begin()  # a correction of the camera changes where everything is that it saw
            before = None
        if before is None and place is None:
            raise StereoSfmError("the session was not found in the saved map yet")
        self._part, s = part, part.snapshot
        ids = s.kf_ids + self._first_kf
        for gone in self._odometry.keys() - set(ids.tolist()):
            del self._odometry[gone]
            self._map.cull_keyframe(self._map.kf_row(gone))
            self._culled.add(gone)
        self._joining.forget_loops()
        # With arrays of their own: views of the part's would keep all of it in memory, part after part.
        keyframes = {k: copy.deepcopy(f) for k, f in enumerate(s.keyframes()) if int(ids[k]) not in self._odometry}
        self._place(s, ids, keyframes, place)
        pt_ids = self._enter_points(s, ids)
        if before is None and place is not None:
            known = dict(zip(s.pt_ids.tolist(), pt_ids.tolist(), strict=True))
            pairs = [(a, known[b]) for a, b in place.matches.tolist() if b in known]
            matches = np.array(pairs, np.int64).reshape(-1, 2)
            loop = dataclasses.replace(place, kf_id=place.kf_id + self._first_kf, matches=matches)
            self._joining.close(loop)
        self._enqueue(s, ids, keyframes, pt_ids)
        self._map.take_delta()  # nobody follows its changes
        if self._map.much_removed:
            self._map.compact(pt_ids)

    def work(self) -> bool:
        """Look for loops of the next keyframe. Returns whether there was something to do."""
        if self._part is None:
            return False
        if self._closer is None:
            self._closer = self._joining.closer(self._vocabulary)
            for keyframe in self._base.snapshot.keyframes():  # the saved map is one rigid piece
                one = dataclasses.replace(keyframe, submap_id=0, stamp_ns=0)
                self._closer.add(one, self._rigs[keyframe.kf_id], rigid=True)
            return True
        if not self._queue:
            return self._adjust()
        self._closer.forget(self._culled)
        keyframe = self._queue.popleft()
        result = self._closer.step(keyframe, self._rigs[keyframe.kf_id])
        if result.candidate_kf_id >= 0 and keyframe.kf_id in self._odometry:
            self._close(result)
        return True

    def saved(self) -> SavedMap:
        """The joined map: in the frame of the saved one, without what later sessions saw in its place."""
        assert self._part is not None
        rest, sessions = without_superseded(*self._joining.content())
        cameras = {**self._base.cameras, self._session: self._part.cameras[int(self._part.sessions.max())]}
        return SavedMap(in_frame_of(self._base.snapshot, rest), cameras, self._vocabulary.id, sessions)

    @property
    def _session(self) -> int:
        return int(self._base.sessions.max()) + 1

    # -- what the session mapped -------------------------------------------------------------------------------------

    def _place(self, s: MapSnapshot, ids: I64, keyframes: dict[int, Keyframe], place: LoopResult | None) -> None:
        """Add the new keyframes: each lies to the newest joined one of its submap as in the session."""
        poses, odometry = self._map.keyframes, self._odometry
        reference: dict[int, int] = {}  # submap -> index of its newest joined keyframe; -1: of any
        moved: F64 | None = None  # saved_T_session of the first keyframes
        if not odometry:
            assert place is not None
            candidate = poses.map_T_kf[self._map.kf_row(place.candidate_kf_id)]
            at = s.map_T_kf[int(np.searchsorted(s.kf_ids, place.kf_id))]
            moved = se3.orthonormalize(candidate @ place.candidate_T_kf @ se3.inverse(at))
        rig = unified([*self._rigs.values(), self._part.rig if self._part else next(iter(self._rigs.values()))])[-1]
        for k, (kf_id, submap) in enumerate(zip(ids.tolist(), s.submap_ids.tolist(), strict=True)):
            if k in keyframes:
                near = reference.get(submap, reference.get(-1))
                step = np.eye(4) if near is None else se3.inverse(s.map_T_kf[near]) @ s.map_T_kf[k]
                own = s.map_T_kf[k]
                if near is not None:
                    moved_to = poses.map_T_kf[self._map.kf_row(int(ids[near]))] @ step
                    own = odometry[int(ids[near])] @ step if submap in reference else own
                else:
                    assert moved is not None
                    moved_to = moved @ s.map_T_kf[k]
                raised = dataclasses.replace(keyframes[k], kf_id=kf_id, submap_id=submap + self._first_submap)
                self._map.add_keyframe(raised, se3.orthonormalize(moved_to))
                odometry[kf_id] = se3.orthonormalize(own)
                self._rigs[kf_id], self._joining.session_of[kf_id] = rig, self._session
            reference[submap] = reference[-1] = k

    def _enter_points(self, s: MapSnapshot, ids: I64) -> I64:
        """Add new points and sightings, cull what the session culled. Returns (P,) the id here of each of its points.

        A point is known by what saw it: those that loops made of corners have other ids each time.
        """
        map_ = self._map
        keys = _keys(ids[s.obs_kf], s.uv_left)
        at = np.minimum(np.searchsorted(self._keys, keys), max(len(self._keys) - 1, 0))
        known = self._keys[at] == keys if len(self._keys) else np.zeros(len(keys), bool)
        none = np.iinfo(np.int64).max
        pt_ids = np.full(len(s.pt_ids), none, np.int64)
        np.minimum.at(pt_ids, s.obs_pt[known], self._key_pt[at[known]])
        fresh = np.flatnonzero(pt_ids == none)
        gone = np.setdiff1d(self._key_pt, pt_ids)
        rows = map_.point_rows(gone)
        map_.cull_points(rows[map_.points.pt_id[rows] == gone])  # else another one has its sightings
        pt_ids[fresh] = self._next_pt + np.arange(len(fresh))
        self._next_pt += len(fresh)
        anchors = np.array([map_.kf_row(k) for k in ids.tolist()], np.int64)
        if len(fresh):
            moved = map_.keyframes.map_T_kf[anchors] @ se3.inverse(s.map_T_kf)
            mine = moved[s.anchors[fresh]]
            xyz = np.einsum("nij,nj->ni", mine[:, :3, :3], s.points[fresh]) + mine[:, :3, 3]
            rows = map_.add_points(pt_ids[fresh], xyz, 0)
            map_.points.anchor[rows] = anchors[s.anchors[fresh]]
            map_.points.sigma[rows] = self._config.mapper.sigma_px
        rows = map_.point_rows(pt_ids)
        add = ~known & map_.points.alive[rows][s.obs_pt]
        for k in np.unique(s.obs_kf[add]).tolist():
            obs = np.flatnonzero(add & (s.obs_kf == k))
            _, once = np.unique(rows[s.obs_pt[obs]], return_index=True)
            obs = obs[np.sort(once)]
            where = rows[s.obs_pt[obs]], s.uv_left[obs], s.uv_right[obs], s.descriptors[obs]
            map_.observe(int(anchors[k]), *where)
        own = map_.points.pt_id[rows] == pt_ids  # not one with a point of the saved map
        map_.points.seen[rows[own]], map_.points.expected[rows[own]] = s.seen[own], s.expected[own]
        order = np.argsort(keys, kind="stable")
        self._keys, self._key_pt = keys[order], pt_ids[s.obs_pt[order]]
        return pt_ids

    # -- loops -------------------------------------------------------------------------------------------------------

    def _enqueue(self, s: MapSnapshot, ids: I64, keyframes: dict[int, Keyframe], pt_ids: I64) -> None:
        """New keyframes for the search, with the ids of this map, after those that the session has not culled."""
        self._queue = deque(keyframe for keyframe in self._queue if keyframe.kf_id in self._odometry)
        for k, keyframe in keyframes.items():
            points, ns = pt_ids[np.searchsorted(s.pt_ids, keyframe.point_ids)], keyframe.stamp_ns - int(s.stamp_ns[0])
            here = {"kf_id": int(ids[k]), "point_ids": points, "odom_T_cam": self._odometry[int(ids[k])]}
            self._queue.append(dataclasses.replace(keyframe, **here, submap_id=keyframe.submap_id + 1, stamp_ns=ns))

    def _close(self, loop: LoopResult) -> None:
        map_ = self._map
        if not map_.keyframes.alive[map_.kf_row(loop.candidate_kf_id)]:
            return
        if self._joining.close(loop):
            self._bent = True
            self._joining.adjust(window.covisible_window(map_, map_.kf_row(loop.kf_id), self._config.mapper))
        elif self._closer is not None:
            self._closer.take_back(loop)

    def _adjust(self) -> bool:
        """Adjust the whole map, if loops have bent it."""
        bent, self._bent = self._bent, False
        if bent:
            self._joining.adjust()
        return bent


def _keys(kf_ids: I64, uv: F64) -> np.ndarray:
    """(M,) uint64 that tells a sighting: the keyframe and the pixel, as the map's files have it."""
    bits = np.ascontiguousarray(uv, np.float32).view(np.uint32).astype(np.uint64)
    pixel = (bits[:, 0] << np.uint64(32)) | bits[:, 1]
    return pixel * _FRACTION + kf_ids.astype(np.uint64)
