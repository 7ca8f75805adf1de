"""The map: columns for keyframes and points and one observation table. Owned by the mapper alone.

Ids are never reused: a culled keyframe or point keeps its row and loses `alive`, a fused point keeps its id as an alias
of the point that replaced it. Rows of removed points and observations stay until `compact` frees them, those of culled
keyframes until loops name them no more (`forget`) and `free_keyframes` is called, so that a day in the same aisles fits
into memory. The observations of a keyframe are one run of rows; those of a point a linked list through the table, so
that the cost of inserting a keyframe depends on its observations, not on the size of the map. Points that a loop made
of corners belong to no track: the tracker never hears of them.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.mapping import map_kernels
from stereo_sfm.mapping.columns import IdRows
from stereo_sfm.mapping.motions import Motion
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.mapping.tables import KeyframeTable, ObservationTable, PointTable
from stereo_sfm.types import F64, I64, U8, Corners, Keyframe

POSE_POINTS = 10  # known points from which a keyframe's pose is solved, three times the least that determine one


class Map:
    """Keyframes, points, observations."""

    def __init__(self) -> None:
        self.keyframes = KeyframeTable()
        self.points = PointTable(1024)
        self.observations = ObservationTable(4096)
        self.corners: dict[int, tuple[Corners, Corners]] = {}  # of living keyframes, by row: `corners`, `sides`
        self.motions: dict[int, Motion] = {}  # by row of the later keyframe: from `previous` to it
        self.known_states: dict[int, tuple[F64, F64]] = {}  # by row: (12,) and (12, 12), see `InertialLink.state`
        self._kf_rows: dict[int, int] = {}
        self._pt_rows = IdRows()
        self._changed_kf: set[int] = set()
        self._culled_kf: list[int] = []
        self._changed_pt: list[I64] = []

    # -- looking up --------------------------------------------------------------------------------------------------

    def kf_row(self, kf_id: int) -> int:
        """Row of a keyframe.

        Raises:
            StereoSfmError: the map has no such keyframe.
        """
        row = self._kf_rows.get(kf_id)
        if row is None:
            raise StereoSfmError(f"the map has no keyframe {kf_id}")
        return row

    def row_since(self, kf_id: int) -> int:
        """Row of the first keyframe from an id on: the keyframe itself, or the next if its row was freed."""
        return int(np.searchsorted(self.keyframes.kf_id, kf_id))

    def point_rows(self, pt_ids: I64) -> I64:
        """(N,) row of each point id after fusions; -1 for an unknown id. Rows of culled points are not alive."""
        rows = self._pt_rows.find(pt_ids)
        map_kernels.follow(rows, self.points.fused_into)
        return rows

    def living_points(self) -> I64:
        """Rows of points that have a position and are not culled."""
        return np.flatnonzero(self.points.alive & np.isfinite(self.points.xyz[:, 0]))

    def living_keyframes(self) -> I64:
        """Rows of keyframes that are not culled."""
        return np.flatnonzero(self.keyframes.alive)

    def observations_of_keyframe(self, row: int) -> I64:
        """Rows of the observations of a keyframe."""
        first = int(self.keyframes.obs_first[row])
        rows = np.arange(first, first + int(self.keyframes.obs_count[row]))
        return rows[self.observations.pt[rows] >= 0]

    def seen_by(self, row: int) -> I64:
        """Rows of the points that a keyframe observes."""
        return self.observations.pt[self.observations_of_keyframe(row)].astype(np.int64)

    def points_of_keyframes(self, rows: I64) -> I64:
        """Rows of the points that any of the keyframes observes, ascending."""
        seen = np.zeros(len(self.points), np.bool_)
        for row in rows.tolist():
            seen[self.seen_by(row)] = True
        return np.flatnonzero(seen)

    def made_by(self, observations: I64, at_least: int = 1) -> I64:
        """Rows of the keyframes that so many of these observations (rows) are of: most first, then oldest first."""
        counts = np.bincount(self.observations.kf[observations])
        rows = np.flatnonzero(counts >= max(at_least, 1))
        return rows[np.argsort(-counts[rows], kind="stable")]

    def neighbours(self, row: int, at_least: int = 1) -> I64:
        """Rows of the keyframes that share so many points with one, in the order of `made_by`."""
        rows = self.made_by(self.sightings(self.seen_by(row))[0], at_least)
        return rows[rows != row]

    def sightings(self, points: I64) -> tuple[I64, I64]:
        """Rows of all observations of points (P,), point after point, newest first, and which of the points each is."""
        points = np.ascontiguousarray(points, np.int64)
        counts = self.points.obs_count[points]
        rows = np.empty(int(counts.sum()), np.int64)
        map_kernels.list_observations(points, self.points.head, self.observations.following, rows)
        return rows, np.repeat(np.arange(len(points)), counts)

    def descriptors_of(self, rows: I64) -> U8:
        """(N, 32) descriptor of each point, zero where it has none."""
        obs = self.points.descriptor_obs[rows]
        return np.where((obs >= 0)[:, None], self.observations.descriptor[np.maximum(obs, 0)], 0).astype(np.uint8)

    # -- growing -----------------------------------------------------------------------------------------------------

    def add_keyframe(self, keyframe: Keyframe, map_T_kf: F64, motion: Motion | None = None) -> int:
        """A keyframe without observations yet, and the motion from the one before. Returns its row.

        Raises:
            StereoSfmError: its id was used before.
        """
        if keyframe.kf_id in self._kf_rows:
            raise StereoSfmError(f"keyframe {keyframe.kf_id} is in the map already: ids are never used twice")
        row = len(self.keyframes)
        same = row > 0 and int(self.keyframes.submap_id[row - 1]) == keyframe.submap_id
        self.keyframes.append(
            1,
            kf_id=keyframe.kf_id,
            frame_id=keyframe.frame_id,
            stamp_ns=keyframe.stamp_ns,
            submap_id=keyframe.submap_id,
            map_T_kf=map_T_kf,
            previous=row - 1 if same else -1,
            down=keyframe.down,
            down_sigma=keyframe.down_sigma,
            doubt=keyframe.doubt + (self.keyframes.doubt[row - 1] if row else 0.0),
            state=0.0 if keyframe.inertial is None else np.delete(keyframe.inertial.state, np.s_[3:6]),  # no gravity
            obs_first=len(self.observations),
        )
        self._kf_rows[keyframe.kf_id] = row
        self.corners[row] = keyframe.corners, keyframe.sides
        if same and motion is not None:
            self.motions[row] = motion
        if keyframe.inertial is not None and keyframe.inertial.covariance.any():
            self.known_states[row] = keyframe.inertial.state, keyframe.inertial.covariance
        self._changed_kf.add(row)
        return row

    def add_points(self, pt_ids: I64, xyz: F64, anchor: int, sigma: float = 1.0) -> I64:
        """Add points with new ids. Returns their rows."""
        if len(pt_ids) and (self.point_rows(pt_ids) >= 0).any():
            raise StereoSfmError("a point id is in the map already: ids are never used twice")
        rows = np.arange(len(self.points), len(self.points) + len(pt_ids))
        self.points.append(len(pt_ids), pt_id=pt_ids, xyz=xyz, anchor=anchor, last_seen=anchor, sigma=sigma)
        self._pt_rows.add(pt_ids, rows)
        self._changed_pt.append(rows)
        return rows

    def add_untracked(self, xyz: F64, anchor: int, sigma: float) -> int:
        """Add a point (3,) that no track belongs to, see `take_delta`. Returns its row."""
        return self.points.append(1, xyz=xyz, anchor=anchor, last_seen=anchor, sigma=sigma).start

    def observe(self, kf: int, pt_rows: I64, uv_left: F64, uv_right: F64, descriptors: U8) -> I64:
        """Further observations of a keyframe, one a point. Returns their rows."""
        if self.keyframes.obs_first[kf] + self.keyframes.obs_count[kf] != len(self.observations):
            self._move_to_end(kf)
        rows = self.observations.append(
            len(pt_rows),
            kf=kf,
            pt=pt_rows,
            uv_left=uv_left,
            uv_right=uv_right,
            sigma=self.points.sigma[pt_rows],
            descriptor=descriptors,
        )
        made = self._link(rows)
        self.keyframes.obs_count[kf] += len(pt_rows)
        self.points.obs_count[pt_rows] += 1
        self.points.seen[pt_rows] += 1
        self.points.last_seen[pt_rows] = np.maximum(self.points.last_seen[pt_rows], kf)
        described = descriptors.any(axis=1)
        self.points.descriptor_obs[pt_rows[described]] = made[described]
        return made

    def _move_to_end(self, kf: int) -> None:
        """Move the observations of a keyframe to the end of the table, where more can follow."""
        table, rows = self.observations, self.observations_of_keyframe(kf)
        columns = {name: getattr(table, name)[rows] for name in table.spec if name != "following"}
        standing = self.points.descriptor_obs[columns["pt"]] == rows
        self._unlink(rows)
        made = self._link(table.append(len(rows), **columns))
        self.points.descriptor_obs[columns["pt"][standing]] = made[standing]
        self.keyframes.obs_first[kf], self.keyframes.obs_count[kf] = len(table) - len(rows), len(rows)

    def _link(self, made: slice) -> I64:
        """Put new observations, of different points, at the heads of their points' lists. Returns their rows."""
        rows, points = np.arange(made.start, made.stop), self.observations.pt[made]
        self.observations.following[rows], self.points.head[points] = self.points.head[points], rows
        return rows

    def _unlink(self, rows: I64) -> None:
        """Take observations out of their points' lists; the points' counts stay."""
        table, points = self.observations, np.unique(self.observations.pt[rows]).astype(np.int64)
        obs, of = self.sightings(points)
        table.pt[rows] = -1
        obs, of = obs[stay := table.pt[obs] >= 0], of[stay]
        table.following[obs] = np.where(of == np.append(of[1:], -1), np.append(obs[1:], -1), -1)
        self.points.head[points] = -1
        self.points.head[points[of[::-1]]] = obs[::-1]  # the first of each point is written last

    # -- changing ----------------------------------------------------------------------------------------------------

    def move_keyframes(self, rows: I64, map_T_kf: F64) -> None:
        """New poses; points stay (see `carry_points`)."""
        self.keyframes.map_T_kf[rows] = map_T_kf
        self._changed_kf.update(rows.tolist())

    def keyframe_poses(self) -> F64:
        """(K, 4, 4) map_T_kf of every row; culled keyframes have moved with their reference keyframes."""
        poses = self.keyframes.map_T_kf.copy()
        gone = np.flatnonzero(~self.keyframes.alive)
        poses[gone] = poses[self.keyframes.reference[gone]] @ self.keyframes.reference_T_kf[gone]
        return poses

    def move_points(self, rows: I64, xyz: F64) -> None:
        """New positions in the map frame; a point whose new one is NaN, or a thousand kilometres away, stays."""
        good = (np.abs(xyz) < 1e6).all(axis=1)
        self.points.xyz[rows[good]] = xyz[good]
        self._changed_pt.append(rows[good])

    def carry_points(self, before: F64, after: F64) -> None:
        """Points follow their anchors after a correction.

        Args:
            before, after: (K, 4, 4) map_T_kf before and after it by row, valid for the living keyframes.
        """
        rows = self.living_points()
        anchor = self._anchors(rows)
        local = np.einsum("nji,nj->ni", before[anchor, :3, :3], self.points.xyz[rows] - before[anchor, :3, 3])
        self.move_points(rows, np.einsum("nij,nj->ni", after[anchor, :3, :3], local) + after[anchor, :3, 3])

    def _anchors(self, rows: I64) -> I64:
        """Living keyframes that carry points of these rows: what carries the anchor, where that was culled."""
        anchor = self.points.anchor[rows]
        return np.where(self.keyframes.alive[anchor], anchor, self.keyframes.reference[anchor])

    def remove_observations(self, rows: I64) -> None:
        """Remove observations; their points stay, even without any."""
        rows = np.unique(np.asarray(rows, np.int64))
        table = self.observations
        rows = rows[table.pt[rows] >= 0]
        if not len(rows):
            return
        points = table.pt[rows].astype(np.int64)
        self._unlink(rows)
        np.subtract.at(self.points.obs_count, points, 1)
        points, standing = np.unique(points), self.points.descriptor_obs
        lost = points[(standing[points] >= 0) & (table.pt[standing[points]] != points)]
        standing[lost] = -1
        obs, of = self.sightings(lost)
        described = table.descriptor[obs].any(axis=1)
        np.maximum.at(standing, lost[of[described]], obs[described].astype(np.int32))

    def cull_points(self, rows: I64) -> None:
        """Cull points with all their observations."""
        rows = rows[self.points.alive[rows]]
        self.remove_observations(self.sightings(rows)[0])
        self.points.alive[rows] = False

    def cull_keyframe(self, row: int) -> None:
        """Cull a keyframe.

        Its points pass to the oldest keyframe that still observes them; its pose is kept relative to the living
        keyframe that shared most points with it (else to the one before it).
        """
        self._carry(row)
        self._culled_kf.append(row)
        rows = self.observations_of_keyframe(row)
        points = self.observations.pt[rows].astype(np.int64)
        self.remove_observations(rows)
        self.keyframes.alive[row] = False
        del self.corners[row]
        self._join_motions(row)
        self.keyframes.previous[self.keyframes.previous == row] = self.keyframes.previous[row]
        obs, of = self.sightings(orphans := points[self.points.anchor[points] == row])
        self.points.anchor[orphans[of]] = len(self.keyframes)
        np.minimum.at(self.points.anchor, orphans[of], self.observations.kf[obs])

    def _join_motions(self, row: int) -> None:
        """The motions to a keyframe and from it become one."""
        self.known_states.pop(row, None)
        first = self.motions.pop(row, None)
        for later in np.flatnonzero(self.keyframes.previous == row).tolist():
            second = self.motions.pop(later, None)
            joined = None if first is None or second is None else first.then(second)
            if joined is not None:
                self.motions[later] = joined

    def _carry(self, row: int) -> None:
        """Make another keyframe the reference of a keyframe, and of those whose reference it was."""
        others = self.neighbours(row)
        reference = int(others[0]) if len(others) else max(int(self.keyframes.previous[row]), 0)
        table = self.keyframes
        reference_T_row = se3.inverse(table.map_T_kf[reference]) @ table.map_T_kf[row]
        carried = np.flatnonzero(table.reference == row)
        table.reference_T_kf[carried] = reference_T_row @ table.reference_T_kf[carried]
        table.reference_T_kf[row] = reference_T_row
        table.reference[carried], table.reference[row] = reference, reference

    def fuse(self, old: int, new: int, sigma: float = 1.0) -> None:
        """Fuse the points of two rows: `new` takes over the observations and ids of `old`.

        Where one keyframe saw both, the observation of `new` stays. Two tracks agree less well than one about where on
        the surface a point is: what `old` was seen by, and what the point is seen by from now on, counts with `sigma`
        pixels.
        """
        points, table = self.points, self.observations
        self.remove_observations(self._seen_with(old, new))
        handed, _ = self.sightings(np.array([old]))
        table.sigma[handed], table.pt[handed] = sigma, new
        if len(handed):
            table.following[handed[-1]], points.head[new] = points.head[new], handed[0]
        points.obs_count[new] += len(handed)
        points.sigma[new] = sigma
        points.seen[new] += points.seen[old]
        points.expected[new] += points.expected[old]
        points.last_seen[new] = max(points.last_seen[new], points.last_seen[old])
        if points.descriptor_obs[new] < 0:
            points.descriptor_obs[new] = points.descriptor_obs[old]
        points.head[old], points.obs_count[old], points.alive[old], points.fused_into[old] = -1, 0, False, new
        self._changed_pt.append(np.array([new]))

    def share_a_keyframe(self, first: int, second: int) -> bool:
        """Whether one keyframe saw the points of both rows."""
        return len(self._seen_with(first, second)) > 0

    def _seen_with(self, point: int, other: int) -> I64:
        """Rows of the observations of one point by keyframes that see the other, too."""
        obs, others = (self.sightings(np.array([p]))[0] for p in (point, other))
        return obs[np.isin(self.observations.kf[obs], self.observations.kf[others])]

    # -- memory ------------------------------------------------------------------------------------------------------

    def forget(self, kf_ids: I64) -> None:
        """No loop will name these keyframes any more; unknown ones are passed over."""
        self.keyframes.named[[self._kf_rows[k] for k in kf_ids.tolist() if k in self._kf_rows]] = False

    @property
    def many_forgotten(self) -> bool:
        """Whether many rows of keyframes are of culled ones that nothing names."""
        return self.keyframes.much_unused(int((self.keyframes.alive | self.keyframes.named).sum()))

    def free_keyframes(self) -> I64:
        """Free the rows of culled keyframes that nothing names; the order of the others stays.

        Only between updates: see `take_delta`.

        Returns:
            (K,) the new row of each keyframe row, -1 of those that were freed.
        """
        table, points = self.keyframes, self.points
        stay = table.alive | table.named
        before = np.cumsum(stay) - 1  # (K,) the row itself, or the one before it that stays
        now = np.where(stay, before, -1)
        points.anchor[:] = now[self._anchors(np.arange(len(points)))]
        points.last_seen[:] = np.where(points.last_seen >= 0, before[points.last_seen], -1)
        self.observations.kf[:] = now[self.observations.kf]
        for column in (table.previous, table.reference):
            column[:] = np.where(column >= 0, now[column], -1)
        table.keep(np.flatnonzero(stay))
        self._kf_rows = {kf_id: row for row, kf_id in enumerate(table.kf_id.tolist())}
        self.corners = {int(now[row]): corners for row, corners in self.corners.items()}
        self.motions = {int(now[row]): motion for row, motion in self.motions.items()}
        self.known_states = {int(now[row]): state for row, state in self.known_states.items()}
        return now

    @property
    def much_removed(self) -> bool:
        """Whether many rows of points or observations are unused."""
        living = self.points.alive
        seen = int(self.points.obs_count[living].sum())
        return self.points.much_unused(int(living.sum())) or self.observations.much_unused(seen)

    def compact(self, followed: I64 | None = None) -> I64:
        """Free the rows of removed points and observations; the order of the others stays.

        The ids of culled points that may come again share one row from then on.

        Args:
            followed: (N,) ids of points that the tracker follows: other culled ones are forgotten. None: they all may
                come again.

        Returns:
            (P,) the new row of each point row.
        """
        points, table = self.points, self.observations
        now = np.arange(len(points))
        map_kernels.follow(now, points.fused_into)
        dead = ~points.alive[now]
        if dead.any():
            now[dead] = np.flatnonzero(~points.alive & (points.fused_into < 0))[0]
        kept = np.unique(now)
        pt_row = np.searchsorted(kept, now)
        obs = np.flatnonzero(table.pt >= 0)
        obs_row = np.append(np.searchsorted(obs, np.arange(len(table))), -1)  # the last one stands for -1: none
        keyframes = self.keyframes
        ends = np.searchsorted(obs, keyframes.obs_first + keyframes.obs_count)
        keyframes.obs_first[:] = np.searchsorted(obs, keyframes.obs_first)
        keyframes.obs_count[:] = ends - keyframes.obs_first
        table.keep(obs)
        table.pt[:] = pt_row[table.pt]
        table.following[:] = obs_row[table.following]
        points.keep(kept)
        points.fused_into[:] = -1
        points.head[:] = np.where(points.alive, obs_row[points.head], -1)
        points.descriptor_obs[:] = np.where(points.alive, obs_row[points.descriptor_obs], -1)
        known = self._pt_rows
        known.rows[:] = pt_row[known.rows]
        if followed is not None:
            known.keep(points.alive[known.rows] | np.isin(known.ids, followed))
        self._changed_pt = [pt_row[rows] for rows in self._changed_pt]
        return pt_row

    # -- copies ------------------------------------------------------------------------------------------------------

    def take_delta(self) -> tuple[I64, I64, I64]:
        """Rows of what has changed since the last call.

        Returns:
            New or moved living keyframes (K,), culled keyframes (R,), new or moved living points that have tracks (P,).
        """
        kf = np.array(sorted(self._changed_kf), np.int64)
        kf = kf[self.keyframes.alive[kf]]
        gone = np.array(self._culled_kf, np.int64)
        pt = np.unique(np.concatenate([np.zeros(0, np.int64), *self._changed_pt]))
        pt = pt[self.points.alive[pt] & np.isfinite(self.points.xyz[pt, 0]) & (self.points.pt_id[pt] >= 0)]
        self._changed_kf.clear()
        self._changed_pt.clear()
        self._culled_kf.clear()
        return kf, gone, pt

    def snapshot(self) -> MapSnapshot:
        """Copy of the living keyframes, points and observations."""
        kfs, pts, table = self.living_keyframes(), self.living_points(), self.observations
        ids = self.points.pt_id[pts]
        ids[ids < 0] = ids.max(initial=-1) + 1 + np.arange(np.count_nonzero(ids < 0))
        order = np.argsort(ids)
        ids, pts = ids[order], pts[order]
        kf_index = np.full(len(self.keyframes), -1, np.int64)
        kf_index[kfs] = np.arange(len(kfs))
        pt_index = np.full(len(self.points) + 1, -1, np.int64)
        pt_index[pts] = np.arange(len(pts))
        obs = np.flatnonzero((table.pt >= 0) & (kf_index[table.kf] >= 0) & (pt_index[table.pt] >= 0))
        obs = obs[np.argsort(table.kf[obs], kind="stable")]
        k, p = self.keyframes, self.points
        counts = np.array([[len(c) for c in self.corners[row]] for row in kfs.tolist()], np.int64).reshape(-1, 2)
        corners = Corners.joined([c for row in kfs.tolist() for c in self.corners[row]])
        return MapSnapshot(
            kf_ids=k.kf_id[kfs],
            frame_ids=k.frame_id[kfs],
            stamp_ns=k.stamp_ns[kfs],
            submap_ids=k.submap_id[kfs],
            map_T_kf=k.map_T_kf[kfs],
            down=k.down[kfs],
            down_sigma=k.down_sigma[kfs],
            pt_ids=ids,
            points=p.xyz[pts],
            anchors=kf_index[self._anchors(pts)],
            seen=p.seen[pts].astype(np.int64),
            expected=p.expected[pts].astype(np.int64),
            obs_kf=kf_index[table.kf[obs]],
            obs_pt=pt_index[table.pt[obs]],
            uv_left=table.uv_left[obs].astype(np.float64),
            uv_right=table.uv_right[obs].astype(np.float64),
            descriptors=table.descriptor[obs],
            corner_kf=np.repeat(np.arange(len(kfs)), counts.sum(1)),
            corner_uv_left=corners.uv_left,
            corner_uv_right=corners.uv_right,
            corner_points=corners.points_cam,
            corner_descriptors=corners.descriptors,
            corner_side=np.repeat(np.tile([False, True], len(kfs)), counts.ravel()),
        )
