"""Poses of all keyframes from the mapper's updates, for log, viewer and evaluation."""

from __future__ import annotations

from stereo_sfm.types import F64, MapUpdate


class KeyframePoses:
    """map_T_kf of every keyframe that there was. A culled keyframe moves with the one that carries it."""

    def __init__(self) -> None:
        self._poses: dict[int, F64] = {}  # of living keyframes: map_T_kf
        self._moves_with: dict[int, tuple[int, F64]] = {}  # of culled ones: reference keyframe's id, its pose in it
        self._all: dict[int, F64] | None = None  # what `all` gave last, until something changes

    def __len__(self) -> int:
        return len(self._poses) + len(self._moves_with)

    def lives(self, kf_id: int) -> bool:
        """Whether the keyframe is known and not culled."""
        return kf_id in self._poses

    def add(self, kf_id: int, map_T_kf: F64) -> None:
        """Add a keyframe before the first update that contains it."""
        self._poses[kf_id], self._all = map_T_kf, None

    def update(self, update: MapUpdate) -> None:
        """Take the poses of one update; copies, so that none keeps the others of its update in memory."""
        self._all = None
        for kf_id, map_T_kf in zip(update.kf_ids.tolist(), update.map_T_kf, strict=True):
            self._poses[kf_id] = map_T_kf.copy()
        culled, references = update.culled_kf_ids.tolist(), update.carrier_kf_ids.tolist()
        for kf_id, reference, reference_T_kf in zip(culled, references, update.carrier_T_kf, strict=True):
            self._poses.pop(kf_id, None)
            self._moves_with[kf_id] = reference, reference_T_kf.copy()

    def all(self) -> dict[int, F64]:
        """map_T_kf (4, 4) by id, ascending, without keyframes whose reference keyframe is unknown."""
        if self._all is not None:
            return self._all
        out = dict(self._poses)
        for kf_id in self._moves_with:
            way, at = list[int](), kf_id
            while at not in out and at in self._moves_with:
                way.append(at)
                at = self._moves_with[at][0]
            if at in out:
                for k in reversed(way):
                    reference, reference_T_kf = self._moves_with[k]
                    out[k] = out[reference] @ reference_T_kf
        self._all = dict(sorted(out.items()))
        return self._all
