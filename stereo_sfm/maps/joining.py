"""Maps of several sessions that become one: loops between them, bundle adjustment with each one's camera."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence

import numpy as np

from stereo_sfm.config import LoopConfig, MapperConfig
from stereo_sfm.loop.closer import LoopCloser
from stereo_sfm.loop.place_view import widest
from stereo_sfm.loop.vocabulary import Vocabulary
from stereo_sfm.mapping import window
from stereo_sfm.mapping.bundle import bundle_adjust
from stereo_sfm.mapping.correction import apply_loop, fuse_sides, loop_is_known
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.maps.saved_map import SavedMap, joined, restore_map
from stereo_sfm.types import I64, LoopResult

log = logging.getLogger("stereo_sfm")


class Joining:
    """A map of several sessions while loops are put into it."""

    def __init__(self, saved: SavedMap, config: LoopConfig, mapper: MapperConfig, last: I64 | None = None) -> None:
        """Args:
        saved: what there is. config: of the loops. mapper: of bundle adjustment.
        last: (maps,) first free keyframe id after each of the maps in it; None: it is one, and others may follow.
        """
        self._config, self._mapper = config, mapper
        self._last = ends([saved], "kf_ids") if last is None else last
        ids = saved.snapshot.kf_ids.tolist()
        self.rigs = dict(zip(ids, saved.keyframe_rigs(), strict=True))  # by keyframe
        self.session_of: dict[int, int] = dict(zip(ids, saved.sessions.tolist(), strict=True))
        self.loops: list[LoopResult] = []  # accepted
        self.fused = 0  # points fused with another one
        self.begin(saved.snapshot)

    def begin(self, snapshot: MapSnapshot) -> None:
        """Go on with this content. All points have the noise of tracked ones: those fused from now on count less."""
        self.map = restore_map(snapshot)
        self.map.points.sigma[:] = self.map.observations.sigma[:] = self._mapper.sigma_px

    def close(self, loop: LoopResult) -> bool:
        """Join what both sides of a loop see, after a correction of the map unless it agrees with the loop.

        Returns:
            False if the pose graph rejects it.
        """
        if loop_is_known(self.map, loop):
            fused, applied = fuse_sides(self.map, loop, self._mapper.match_sigma_px), True
        else:
            sigma_px = self._mapper.match_sigma_px
            done = apply_loop(self.map, loop, self.loops, self._config, sigma_px, self._bridges())
            fused, applied = done.fused, done.applied
        if applied:
            self.loops.append(loop)
        self.fused += len(fused)
        return applied

    def _bridges(self) -> tuple[I64, I64]:
        """Rows of successive keyframes of each map between which tracking was lost: a map moves as a whole."""
        table, living = self.map.keyframes, self.map.living_keyframes()
        of_map = np.searchsorted(self._last, table.kf_id[living], side="right")
        cut = (table.previous[living[1:]] < 0) & (of_map[1:] == of_map[:-1])
        return living[:-1][cut], living[1:][cut]

    def forget_loops(self) -> None:
        """Of culled keyframes: nothing asks for them, and a session that goes on all day has ever more."""
        row, alive = self.map.kf_row, self.map.keyframes.alive
        self.loops = [x for x in self.loops if alive[row(x.candidate_kf_id)] and alive[row(x.kf_id)]]

    def adjust(self, part: window.Window | None = None) -> None:
        """Bundle adjustment with the mapper's settings, of the whole map with the first keyframe fixed, or of a part.

        Outlier observations are removed afterwards, and points that too few keyframes still observe.
        """
        part, whole, map_ = part or window.whole_map(self.map), part is None, self.map
        taken = [self.rigs[k] for k in map_.keyframes.kf_id[part.kf_rows].tolist()]
        number = {rig: i for i, rig in enumerate(dict.fromkeys(taken))}
        which = np.array([number[rig] for rig in taken], np.int64) if len(number) > 1 else None
        bundle = dataclasses.replace(part.bundle, kf_rig=which)
        result = bundle_adjust(list(number), bundle, window.bundle_config(self._mapper))
        window.write_back(map_, part, result)
        map_.cull_points(part.pt_rows[map_.points.obs_count[part.pt_rows] < 2])
        if whole:
            log.info("full bundle adjustment: cost %.1f to %.1f", result.initial_cost, result.cost)

    def content(self) -> tuple[MapSnapshot, I64]:
        """The map, and the session (K,) of each of its keyframes."""
        snapshot = self.map.snapshot()
        return snapshot, np.array([self.session_of[k] for k in snapshot.kf_ids.tolist()], np.int64)

    def closer(self, vocabulary: Vocabulary) -> LoopCloser:
        """A loop closer that looks for every link between sessions, by the widest rig, of equals the newest."""
        rigs = list(self.rigs.values())
        eager = dataclasses.replace(self._config, pause=2)  # keyframes
        return LoopCloser(eager, widest(rigs[::-1]), vocabulary)


def join(
    maps: Sequence[SavedMap],
    vocabulary: Vocabulary,
    config: LoopConfig,
    mapper: MapperConfig,
    place: LoopResult | None,
    rigid: bool = False,
) -> tuple[SavedMap, Joining]:
    """Put maps side by side and close the loops of the later ones with all before them.

    Args:
        place: a known loop from the first map to the second, in the ids of each.
        rigid: the first map is one piece, whose keyframes tell nothing of the time between them.

    Returns:
        The maps side by side, and what was made of them.
    """
    both = joined(list(maps))
    joining = Joining(both, config, mapper, ends(maps, "kf_ids"))
    closer = joining.closer(vocabulary)
    stamps = both.snapshot.stamp_ns
    begins = {k: int(stamps[both.sessions == k].min()) for k in both.session_ids}  # sessions have unrelated clocks
    others_begin, point_begin = (int(ends(maps, ids)[0]) for ids in ("kf_ids", "pt_ids"))
    if place is not None:
        matches = place.matches + np.array([0, point_begin])
        joining.close(dataclasses.replace(place, kf_id=place.kf_id + others_begin, matches=matches))
    for keyframe, rig in zip(both.snapshot.keyframes(), list(joining.rigs.values()), strict=True):
        kf_id, stamp_ns = keyframe.kf_id, keyframe.stamp_ns - begins[joining.session_of[keyframe.kf_id]]
        if kf_id >= others_begin:
            result = closer.step(dataclasses.replace(keyframe, stamp_ns=stamp_ns), rig)
            if result.candidate_kf_id >= 0 and not joining.close(result):
                closer.take_back(result)
        elif rigid:
            closer.add(dataclasses.replace(keyframe, submap_id=0, stamp_ns=0), rig, rigid=True)
        else:  # its own loops are in the map
            closer.add(dataclasses.replace(keyframe, stamp_ns=stamp_ns), rig)
    return both, joining


def ends(maps: Sequence[SavedMap], ids: str) -> I64:
    """(maps,) first free id after each map in the numbering of `joined`."""
    return np.cumsum([int(getattr(saved.snapshot, ids).max()) + 1 for saved in maps])
