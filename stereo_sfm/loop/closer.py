"""The loop closer: one result for each keyframe."""

from __future__ import annotations

import dataclasses
import functools
import math
from bisect import bisect
from collections import deque
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.choice import with_terms
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import LoopConfig
from stereo_sfm.geometry import se3
from stereo_sfm.loop import vocabulary as voc
from stereo_sfm.loop.cloud import CLOUD_KEYFRAMES, Cloud, gather
from stereo_sfm.loop.database import PlaceDatabase, apart
from stereo_sfm.loop.graph import REMEMBERED, KeyframeGraph
from stereo_sfm.loop.keyframe_store import KeyframeStore
from stereo_sfm.loop.place_view import PlaceView, place_view_of
from stereo_sfm.loop.sideways import (
    MIN_CORNERS,
    SIDE_FACTOR,
    TURNED,
    Fronts,
    front_of,
    of_a_part,
    with_neighbours,
)
from stereo_sfm.loop.verification import (
    CONFIDENT_SHARE,
    Verdict,
    corner_sightings,
    looks_alike,
    rejection,
    verify,
    verify_near,
)
from stereo_sfm.loop.vocabulary import Vocabulary
from stereo_sfm.mapping.culling import OF_A_VIEW, OF_EARLIER_VISITS, PASSED
from stereo_sfm.timing import NoSpans
from stereo_sfm.tracking.flow.motion_prior import DRIFT
from stereo_sfm.types import F64, RIG_TERMS, Keyframe, LoopResult

PLACE_RADIUS = 3  # keyframes: of candidates at most so many apart, which are one place, only the best is verified
RIVAL = 0.5  # share of a loop's inliers, or of its support, above which another place makes it ambiguous
TWIN = 0.85  # the corresponding limit of the share of corners of its best keyframe, where several found it
GAP_WINDOW = 12  # newest keyframes with corners that support a loop across a gap, or contradict it
CONTRADICTED = "against_odometry", "out_of_reach"  # reasons of impossible hypotheses, which are no rivals
SAME_LOOP = 0.15, math.radians(2.0)  # metres, radians between two keyframes' estimates of one: noise, and drift
DOUBT_SIGMAS = 3.0  # of odometry in doubt that a loop may contradict: noise does in one of 400


@dataclass(frozen=True)
class Candidate:
    """A keyframe whose place may be the newest one's."""

    kf_id: int
    score: float
    sideways: bool = False  # by the corners of the views that face the shelves


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A geometrically verified candidate."""

    kf_id: int
    candidate_kf_id: int
    candidate_T_kf: F64
    inliers: int
    against: str  # reason to reject it by odometry, "" if there is none
    unconnected: bool  # no path of odometry and loops connects its ends: only appearance supports it
    anywhere: bool  # neither does a gap bound the motion between them: they are of two sessions
    votes: int  # keyframes that must agree on it
    sideways: bool  # by views to the side
    share: float  # of the keyframe's corners, ahead and beside, that agree with it


class LoopCloser:
    """Finds loops; owns the place database.

    Candidates by appearance (bag of words) are verified geometrically (`verify`). A loop must not contradict odometry
    by more than drift can explain, and successive keyframes must agree on it. Across a gap in tracking one keyframe
    with strong evidence is enough, if the motion that it implies is possible.
    """

    def __init__(self, config: LoopConfig, rig: Rig, vocabulary: Vocabulary, spans: NoSpans | None = None) -> None:
        self._config, self._rig, self._spans = config, rig, spans or NoSpans()
        self._side_config = of_a_part(config, config.side_inliers)
        self._chance = config.relocalize_share  # of corners that agree where a place only looks alike
        self._source_rig, self._rig_terms = rig, np.zeros(RIG_TERMS)
        self._own: dict[int, Rig] = {}  # of keyframes of other rigs
        self._vocabulary = vocabulary
        self._database = PlaceDatabase(len(vocabulary))
        self._side_database = PlaceDatabase(len(vocabulary))  # with the same rows
        self._fronts = Fronts(rig.left)
        self._row: dict[int, int] = {}  # keyframe id -> row in the database
        self._store = KeyframeStore()
        self._graph = KeyframeGraph()
        self._pending: list[_Hypothesis] = []
        self._alike: deque[_Hypothesis] = deque(maxlen=REMEMBERED)  # between sessions, since the last loop
        self._same_loop = functools.lru_cache(REMEMBERED)(self._agree)
        # newest keyframes with corners
        self._described: deque[int] = deque(maxlen=max(GAP_WINDOW, config.consistent_window))
        self._repeated = 0  # keyframes added to views of earlier visits, less those removed there
        self._last_loop = -1
        self._sees_sides = False  # some keyframe had views that face shelves

    def step(self, keyframe: Keyframe, own: Rig | None = None) -> LoopResult:
        """Look for a loop with earlier keyframes, then add the keyframe.

        Args: own, the rig that took it; None: the closer's.
        """
        bags = self._enter(keyframe, own)
        unseen = LoopResult.without_loop(keyframe.kf_id, "not_described")
        result = self._search(keyframe, bags) if keyframe.described else unseen
        self._keep(keyframe, bags)
        gone = self._cull(keyframe.kf_id)
        return dataclasses.replace(result, forgotten_kf_ids=np.array(gone, np.int64)) if gone else result

    def _search(self, keyframe: Keyframe, bags: tuple[voc.Bag, voc.Bag]) -> LoopResult:
        """Look for a loop with a keyframe that has corners."""
        self._described.append(keyframe.kf_id)
        with self._spans.span("loop_query"):
            candidates, why_none = self._candidates(keyframe, *bags)
        with self._spans.span("loop_verify"):
            return self._judge(keyframe, candidates, why_none)

    def add(self, keyframe: Keyframe, own: Rig | None = None, rigid: bool = False) -> None:
        """Add a keyframe of a finished map, to which later ones may close loops.

        Args: own, as of `step`. rigid: the map is one piece, whose keyframes lie to each other as their poses say.
        """
        self._keep(keyframe, self._enter(keyframe, own, rigid))

    def take_back(self, loop: LoopResult) -> None:
        """The map has refused the loop of the last step: it leads nowhere. Points that it joined stay so."""
        self._graph.take_back_loop(loop.candidate_kf_id, loop.kf_id)
        self._same_loop.cache_clear()

    def add_loop(self, loop: LoopResult) -> None:
        """Add a loop between added keyframes that was accepted before."""
        self._graph.add_loop(loop.candidate_kf_id, loop.kf_id, loop.candidate_T_kf)
        self._store.merge(loop.matches)

    def _view(self, keyframe: Keyframe, sideways: bool) -> PlaceView:
        sigma, own = self._config.disparity_sigma_px, self._own.get(keyframe.kf_id)
        return place_view_of(keyframe, self._rig, sigma, sideways, own)

    def _cloud(self, centre: Keyframe, around: list[Keyframe], sideways: bool) -> Cloud:
        own = [self._own.get(k.kf_id, self._rig) for k in (centre, *around)] if self._own else []
        return gather(centre, around, self._rig, self._config.disparity_sigma_px, sideways, own)

    def _enter(self, keyframe: Keyframe, own: Rig | None, rigid: bool = False) -> tuple[voc.Bag, voc.Bag]:
        """Its words and those of its side views; what candidates are judged by knows the keyframe from now on."""
        if own is not None and own is not self._rig:
            self._own[keyframe.kf_id] = own
        if not np.array_equal(keyframe.rig_terms, self._rig_terms):  # the tracker's rig was corrected
            self._rig_terms = keyframe.rig_terms
            self._rig = with_terms(self._source_rig, self._rig_terms)
        k = keyframe
        self._graph.add(k.kf_id, k.odom_T_cam, k.submap_id, k.stamp_ns, k.doubt, rigid)
        with self._spans.span("loop_words"):
            bag, side_bag = (self._vocabulary.bag(c.descriptors) for c in (keyframe.corners, keyframe.sides))
        self._fronts.add(keyframe)
        self._sees_sides |= len(keyframe.sides) >= MIN_CORNERS
        return bag, side_bag

    def _keep(self, keyframe: Keyframe, bags: tuple[voc.Bag, voc.Bag]) -> None:
        """The keyframe can be a candidate from now on, if it has corners."""
        if not keyframe.described:
            self._graph.exclude(keyframe.kf_id)
            return
        self._row[keyframe.kf_id] = len(self._database)
        self._database.add(keyframe.kf_id, bags[0])
        self._side_database.add(keyframe.kf_id, bags[1])
        self._store.add(keyframe)

    def forget(self, culled: set[int]) -> None:
        """Keyframes that their map has culled are no candidates any more; those passed are taken out of the set."""
        newest = self._store.ids[-1] if len(self._store) else -1
        for kf_id in sorted(kf_id for kf_id in culled if kf_id <= newest - PASSED):
            culled.remove(kf_id)
            if kf_id in self._store:
                self._remove(kf_id)

    def _remove(self, kf_id: int) -> None:
        self._graph.exclude(kf_id)
        self._store.remove(kf_id)
        self._own.pop(kf_id, None)

    def _cull(self, newest: int) -> list[int]:
        """Of many keyframes of one view keep the first and the last few, which bounds memory in a known place.

        Returns:
            Keyframes that are no candidates any more, or never were.
        """
        settled = newest - PASSED
        if settled not in self._store:
            return [settled] if settled >= 0 else []
        before = self._store.ids[: bisect(self._store.ids, settled)]
        known = [k for k in self._graph.same_view(settled, 2) if k <= settled]  # one is as good as the other
        came_back = known[0] < max(set(before).difference(known), default=-1)
        same_view = [k for k in self._graph.same_view(settled) if k <= settled]
        gone = same_view[1] if len(same_view) > OF_A_VIEW else -1
        if came_back and self._repeated >= OF_EARLIER_VISITS:
            gone = settled
        if gone >= 0:
            self._remove(gone)
        self._repeated += came_back and gone < 0
        if (rows := self._graph.forget()) is not None:
            self._fronts.keep(rows)
        if 2 * len(self._store) < len(self._database) - PASSED:
            self._row = {k: row for row, k in enumerate(self._store.ids)}
            kept = np.flatnonzero(np.isin(self._database.kf_ids, self._store.ids))
            self._database.keep(kept)
            self._side_database.keep(kept)
        return [gone] if gone >= 0 else []

    def _candidates(self, keyframe: Keyframe, bag: voc.Bag, side_bag: voc.Bag) -> tuple[list[Candidate], str]:
        """Places to verify, best first, those across directions at the end, and the reason when there are none."""
        config = self._config
        if not config.enabled:
            return [], "disabled"
        if self._paused(keyframe.kf_id):
            return self._side_candidates(keyframe, side_bag, None), "paused"
        connected = self._store.connected(keyframe.point_ids, config.connected_points)
        scores = self._database.scores(bag)
        pick = max if config.reference == "best" else min
        reference = pick((scores[self._row[k]] for k in connected), default=0.0)
        bound = max(config.score_ratio * reference, config.min_score)
        excluded = self._near(keyframe.kf_id, connected)
        good = np.flatnonzero(scores > bound)
        good = self._database.kf_ids[good[np.argsort(-scores[good], kind="stable")]].tolist()
        near = self._graph.nearby(keyframe.kf_id, excluded) if config.proximity else []
        free = (k for k in good if k in self._store and k not in excluded)
        places = apart(free, PLACE_RADIUS, config.max_candidates + len(near), near)
        found = [Candidate(k, float(scores[self._row[k]])) for k in places]
        return found + self._side_candidates(keyframe, side_bag, excluded), "no_candidate"

    def _paused(self, kf_id: int) -> bool:
        """Whether the last loop was so shortly before that only the way back along it is looked for."""
        return kf_id - self._last_loop <= self._config.pause and self._graph.unbroken(self._last_loop, kf_id)

    def _side_candidates(self, keyframe: Keyframe, bag: voc.Bag, excluded: set[int] | None) -> list[Candidate]:
        """The keyframe that should have seen the same fronts, by odometry, and those whose views look most alike.

        Args: excluded, not these; None: only the one by odometry, as the search pauses.
        """
        if len(keyframe.sides) < MIN_CORNERS:
            return []
        scores = self._side_database.scores(bag)
        graph_ids, cam_T_kf = self._graph.around(keyframe.kf_id)
        pauses, ahead = excluded is None, set(graph_ids[cam_T_kf[:, 2, 2] >= TURNED].tolist())
        excluded = set[int]() if excluded is None else excluded | ahead  # whose other corners show more
        turned = graph_ids[self._fronts.turned(front_of(keyframe), cam_T_kf)].tolist()
        places = [k for k in turned if k in self._store and k not in excluded][:1]
        wanted = 2 if places else self._config.max_candidates
        if not pauses:
            best = np.argsort(-with_neighbours(scores), kind="stable")
            good = best[np.logical_and.accumulate(scores[best] >= self._config.min_score)]
            ids = self._side_database.kf_ids[good].tolist()
            free = (k for k in ids if k in self._store and k not in excluded)
            places = apart(free, PLACE_RADIUS, wanted, places)
        return [Candidate(k, float(scores[self._row[k]]), True) for k in places]

    def _near(self, kf_id: int, connected: list[int]) -> set[int]:
        """Keyframes that cannot be candidates: connected to this one, or shortly before it in the same submap."""
        before = range(max(kf_id - self._config.min_gap, 0), kf_id + 1)
        return {*connected, *(k for k in before if self._graph.unbroken(k, kf_id))}

    def _judge(self, keyframe: Keyframe, candidates: list[Candidate], why_none: str) -> LoopResult:
        verdicts: list[Verdict] = []
        loops: dict[int, _Hypothesis] = {}
        for k, candidate in enumerate(candidates):
            if candidate.sideways and any(not loop.against for loop in loops.values()):
                break
            verdicts.append(self._verify(keyframe, candidate))
            if not verdicts[k].reason:
                loops[k] = self._hypothesis(keyframe, candidate, verdicts[k])
        if not candidates:
            return LoopResult.without_loop(keyframe.kf_id, why_none)
        candidates = candidates[: len(verdicts)]
        reasons = [verdict.reason for verdict in verdicts]
        best_inliers = max((loop.inliers for loop in loops.values() if not loop.against), default=0)
        self._pending = [h for h in self._pending if h.kf_id in self._described]
        self._pending += [h for h in loops.values() if h.against or h.inliers >= RIVAL * best_inliers]
        self._alike.extend(h for h in loops.values() if h.anywhere and not h.sideways)
        accepted = -1
        for k in sorted(loops, key=lambda k: -loops[k].inliers):
            reasons[k] = loops[k].against or self._objection(loops[k], best_inliers)
            if not reasons[k]:
                accepted = k
                break
        rejected = tuple((c.kf_id, c.score, why) for c, why in zip(candidates, reasons, strict=True) if why)
        if accepted >= 0:
            result = self._accept(keyframe, candidates[accepted], verdicts[accepted])
            return dataclasses.replace(result, rejected=rejected)
        return LoopResult.without_loop(keyframe.kf_id, reasons[0], candidates[0].score, rejected)

    def _verify(self, keyframe: Keyframe, candidate: Candidate) -> Verdict:
        config = self._side_config if candidate.sideways else self._config
        view, centre = self._view(keyframe, candidate.sideways), self._store[candidate.kf_id]
        if not candidate.sideways and not looks_alike(view, centre, config):
            return rejection("too_few_matches")
        around = self._around(centre)
        cloud = self._cloud(centre, around, candidate.sideways)
        rng = np.random.default_rng([config.seed, keyframe.kf_id, candidate.kf_id])
        verdict = verify(view, cloud, self._rig, config, rng, move_points=not candidate.sideways)
        if verdict.reason or not candidate.sideways:  # points of views ahead are shared, not corners
            return verdict
        if verdict.b_T_a[2, 2] >= TURNED:
            return rejection("same_direction", verdict.inliers)  # other corners show it more precisely
        sightings = corner_sightings(view, cloud, verdict.rows)
        sightings[:, 1] = np.array([k.kf_id for k in (centre, *around, keyframe)])[sightings[:, 1]]
        return dataclasses.replace(verdict, sightings=sightings)

    def _around(self, centre: Keyframe) -> list[Keyframe]:
        """The connected keyframes whose points are added to a candidate's own."""
        around = [self._store[k] for k in self._store.best_connected(centre.kf_id, CLOUD_KEYFRAMES)]
        return [k for k in around if k.submap_id == centre.submap_id]

    def _agreeing_share(self, keyframe: Keyframe, candidate: int, verdict: Verdict) -> float:
        """Share of a keyframe's corners, ahead and beside, that agree with a pose found by those ahead.

        Rows of lamps look alike one lamp further on, in the next aisle and from the other side. Shelves do not: where
        others have views that face them, a keyframe without says little.
        """
        corners, inliers = len(keyframe.corners), verdict.inliers
        if self._sees_sides:
            corners += max(len(keyframe.sides), self._config.side_corners)
        if len(keyframe.sides) >= MIN_CORNERS:
            centre, config = self._store[candidate], self._side_config
            cloud = self._cloud(centre, self._around(centre), True)
            if cloud.corner.sum() >= MIN_CORNERS:
                inliers += verify_near(verdict.b_T_a, self._view(keyframe, True), cloud, self._rig, config).inliers
        return inliers / max(corners, 1)

    def _hypothesis(self, keyframe: Keyframe, of: Candidate, verdict: Verdict) -> _Hypothesis:
        """A verified candidate, compared with the odometry between its ends.

        Across a gap there is none. What the robot can have moved meanwhile bounds where it is; within that, strong
        geometric evidence is believed at once, less or more distant evidence when another keyframe agrees.
        """
        config, candidate_T_kf = self._config, se3.inverse(verdict.b_T_a)
        kf_id, candidate, votes, share = keyframe.kf_id, of.kf_id, self._config.consistent, verdict.share
        path, anywhere = self._graph.path(candidate, kf_id), False
        if path is not None:
            gate = config.gate(path.metres) + DOUBT_SIGMAS * path.sigmas
            near = se3.within(path.a_T_b, candidate_T_kf, *gate)
            against = "" if near else "against_odometry"
        else:
            gap = self._graph.gap_motion(candidate, kf_id, candidate_T_kf)
            anywhere = gap is None
            off = math.nan if gap is None else gap.deviation - DRIFT[0] * gap.distance - config.gate_m
            if of.sideways:
                enough = verdict.inliers >= SIDE_FACTOR * config.side_inliers
            else:
                least = 2 * config.min_inliers
                enough = verdict.inliers >= least and verdict.share >= config.min_inlier_share_after_gap
                share = self._agreeing_share(keyframe, candidate, verdict)
                strong = verdict.inliers >= 3 * config.min_inliers and min(verdict.share, share) >= CONFIDENT_SHARE
                votes = 1 if strong and gap is not None and off <= gap.tolerance else votes
            reached = gap is None or off <= gap.disturbed
            against = "out_of_reach" if not reached else "" if enough else "too_few_inliers"
        inliers, sideways, unconnected = verdict.inliers, of.sideways, path is None
        return _Hypothesis(
            kf_id, candidate, candidate_T_kf, inliers, against, unconnected, anywhere, votes, sideways, share
        )

    def _objection(self, loop: _Hypothesis, best_inliers: int) -> str:
        """Why a loop that odometry allows is not accepted, '' if it is.

        `best_inliers`: of the best candidate that odometry allows.
        """
        if loop.inliers < RIVAL * best_inliers:
            return "better_elsewhere"
        if not loop.unconnected:
            return "" if len(self._support(loop, self._config.consistent_window)) >= loop.votes else "not_confirmed_yet"
        support = self._support(loop, GAP_WINDOW)
        if any(self._rivals(h, loop, support) for h in self._pending):
            return "ambiguous"
        if loop.anywhere and not loop.sideways and self._looked_alike(loop, max(support.values())):
            return "ambiguous"
        enough = loop.votes == 1 or loop.sideways or self._total(support) >= 2 * (CONFIDENT_SHARE - self._chance)
        return "" if len(support) >= loop.votes and enough else "not_confirmed_yet"

    def _rivals(self, other: _Hypothesis, loop: _Hypothesis, support: dict[int, float]) -> bool:
        """Whether so much speaks for another place that appearance cannot tell which one it is.

        Along an aisle both directions look somewhat alike: what corners ahead and corners beside show is comparable
        only if there are enough of both.
        """
        possible = not other.against or (other.against not in CONTRADICTED and other.sideways == loop.sideways)
        if not possible or self._same_loop(other, loop) is not False:
            return False
        others = self._support(other, GAP_WINDOW)
        alike = RIVAL if len(support) == 1 else TWIN
        more = self._total(others) > RIVAL * self._total(support)
        return more or max(others.values()) > alike * max(support.values())

    def _looked_alike(self, loop: _Hypothesis, share: float) -> bool:
        """Whether some other place looked about as much like a keyframe of this session as this one does.

        Lamps at equal distances and shelves with equal products: how much alike wrong places look depends on the store,
        and that successive keyframes agree on one says little where they all are displaced by the same lamps.
        """
        return any(h.share > TWIN * share and self._same_loop(h, loop) is False for h in self._alike)

    def _support(self, loop: _Hypothesis, window: int) -> dict[int, float]:
        """The keyframes among the newest that found a loop, and the share of the corners of each that agree with it."""
        newest = list(self._described)[-window:]
        shares: dict[int, float] = {}
        for h in self._pending:
            if h.kf_id in newest and (h is loop or (not h.against and self._same_loop(h, loop))):
                shares[h.kf_id] = max(h.share, shares.get(h.kf_id, 0.0))
        return shares

    def _total(self, support: dict[int, float]) -> float:
        """What speaks for a loop: by how much the shares of the keyframes that found it exceed those of chance."""
        return sum(max(share - self._chance, 0.0) for share in support.values())

    def _agree(self, earlier: _Hypothesis, new: _Hypothesis) -> bool | None:
        """Whether two loops agree; None if no path connects them."""
        back = self._graph.path(earlier.candidate_kf_id, new.candidate_kf_id)
        ahead = self._graph.path(new.kf_id, earlier.kf_id)
        if back is None or ahead is None:
            return None
        implied = back.a_T_b @ new.candidate_T_kf @ ahead.a_T_b
        return se3.within(earlier.candidate_T_kf, implied, *SAME_LOOP)

    def _accept(self, keyframe: Keyframe, candidate: Candidate, verdict: Verdict) -> LoopResult:
        candidate_T_kf = se3.inverse(verdict.b_T_a)
        self._graph.add_loop(candidate.kf_id, keyframe.kf_id, candidate_T_kf)
        self._store.merge(verdict.pairs)
        if not self._paused(keyframe.kf_id):
            self._last_loop = keyframe.kf_id
        self._pending.clear()
        self._alike.clear()
        self._same_loop.cache_clear()
        return LoopResult(
            kf_id=keyframe.kf_id,
            candidate_kf_id=candidate.kf_id,
            candidate_T_kf=candidate_T_kf,
            information=verdict.information,
            matches=verdict.pairs,
            inliers=verdict.inliers,
            score=candidate.score,
            reason="",
            sightings=verdict.sightings,
        )
