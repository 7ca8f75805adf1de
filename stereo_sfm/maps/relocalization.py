"""Relocalization in a saved map: bag-of-words retrieval, pose from bearings, verification; no prediction needed."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import LoopConfig
from stereo_sfm.geometry import se3
from stereo_sfm.loop.absolute_pose import Matches, joined, refine_pose
from stereo_sfm.loop.cloud import CLOUD_KEYFRAMES, Cloud, gather
from stereo_sfm.loop.database import PlaceDatabase, apart
from stereo_sfm.loop.place_view import KEPT, PlaceView, place_view_of, widest
from stereo_sfm.loop.sideways import MIN_CORNERS, SIDE_FACTOR, TURNED, Fronts, front_of, of_a_part, with_neighbours
from stereo_sfm.loop.verification import CONFIDENT_SHARE, Verdict, pair, verify, verify_near
from stereo_sfm.loop.vocabulary import Vocabulary, counted
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.tracking.flow.recovery import RIVAL
from stereo_sfm.types import F64, I64, Keyframe

SAME_PLACE = 0.2, math.radians(5.0)  # metres, radians between results: lamps and products repeat at larger steps
MIN_RANGE_SIGMA_M = 0.003  # metres, of a point of the map however many keyframes saw it: the map bends a little
PLACES = 16  # that are verified for an image, and for its side views, where no confident one ends the search
CLOSER_PLACES, CLOSER_VIEWS = 4, 3  # ambiguous places that are compared again, from so many keyframes around each
CLOSER_SHARE = 0.2  # of the weight of all corners; other stores with the same products have less in nine of ten


@dataclass(frozen=True, eq=False)
class Location:
    """The result; `reason` is empty when the camera was found."""

    reason: str  # "", "no_candidate", "ambiguous", or why the best candidate failed
    map_T_cam: F64  # (4, 4) pose in the map, metres; identity when not found
    information: F64  # (6, 6) inverse covariance of map_T_cam @ exp(xi), xi = (translation, rotation): m^-2, rad^-2
    kf_id: int  # matched keyframe of the map, -1: none
    inliers: int  # corners that agree on the pose
    pairs: I64  # (M, 2) point ids of the map and of the camera
    confident: bool = False  # far more inliers than required
    # other corners that agree, beside for a pose found ahead, ahead for one found beside; -1: not compared
    others: int = -1

    @property
    def found(self) -> bool:
        """Whether the pose is valid."""
        return not self.reason

    @property
    def agreeing(self) -> int:
        """Corners ahead and beside."""
        return self.inliers + max(self.others, 0)


def not_found(reason: str, inliers: int = 0) -> Location:
    return Location(reason, np.eye(4), np.zeros((6, 6)), -1, inliers, np.zeros((0, 2), np.int64))


def _distinct(a: Location, b: Location) -> bool:
    """Whether they are different places."""
    return not se3.within(a.map_T_cam, b.map_T_cam, *SAME_PLACE)


class Relocalizer:
    """Finds cameras in a map. Results depend on the map, the configuration and the view only."""

    def __init__(
        self, snapshot: MapSnapshot, rig: Rig, vocabulary: Vocabulary, config: LoopConfig, map_rigs: Sequence[Rig] = ()
    ) -> None:
        """Args:
        rig: of the camera. map_rigs: of each keyframe of the map, the same object for equal ones; none: the camera's.
        """
        self.map, self._own = snapshot, list(map_rigs) or [rig] * len(snapshot.kf_ids)
        self._keyframes = snapshot.keyframes()
        self._described = np.array([k.described for k in self._keyframes], bool)
        self._near_share = config.min_inlier_share
        self.config = of_a_part(config, config.relocalize_inliers // 3)  # competing places must be known
        self._side_inliers = config.side_inliers
        self._side_config = of_a_part(config, self._side_inliers // 2)
        shape = (len(snapshot.kf_ids), len(snapshot.pt_ids))
        ones = np.ones(len(snapshot.obs_kf), np.int32)
        self._seen = scipy.sparse.csr_array((ones, (snapshot.obs_kf, snapshot.obs_pt)), shape=shape)
        self._sees = self._seen.T.tocsr()
        self._views = np.maximum(np.bincount(snapshot.obs_pt, minlength=shape[1]), 1)
        self._cloud = functools.lru_cache(maxsize=KEPT)(self._gather)  # cameras ask from near where they were
        self.use(rig)
        self._vocabularies: list[Vocabulary] = []  # ahead and beside, with the idf of this map
        self._databases: list[PlaceDatabase] = []
        for corners in ([k.corners for k in self._keyframes], [k.sides for k in self._keyframes]):
            words = [vocabulary.words(c.descriptors) for c in corners]
            own, database = counted(vocabulary, [w for w, _ in words if len(w)]), PlaceDatabase(len(vocabulary))
            for k, (found, counts) in enumerate(words):
                database.add(k, own.weighed(found, counts))
            self._vocabularies.append(own)
            self._databases.append(database)
        self._fronts = Fronts(rig.left)
        self._has_sides = any(len(k.sides) >= MIN_CORNERS for k in self._keyframes)
        for keyframe in self._keyframes:
            self._fronts.add(keyframe)

    def use(self, camera: Rig) -> None:
        """Use a corrected rig of the camera."""
        self.camera = camera
        self._rig = widest([camera, *dict.fromkeys(self._own)])  # whose pixels are compared
        self._cloud.cache_clear()

    def locate(self, keyframe: Keyframe) -> Location:
        """Find the camera of a keyframe (its pose is ignored) in the map, if need be from another direction."""
        place = self._find(keyframe)
        return self._refined(keyframe, place) if place.found else place

    def _find(self, keyframe: Keyframe) -> Location:
        """`locate`, with the pose of the first keyframe of the map that showed the place."""
        found_ahead, reason = self._search(keyframe, False)
        ahead = self._choose(found_ahead, reason)
        if len(keyframe.sides) < MIN_CORNERS or (ahead.found and self._confirmed(ahead)):
            return ahead
        found_beside, reason = self._search(keyframe, True)
        beside = self._choose(found_beside, reason)
        if beside.found:
            row = int(np.searchsorted(self.map.kf_ids, beside.kf_id))
            if (se3.inverse(self.map.map_T_kf[row]) @ beside.map_T_cam)[2, 2] < TURNED:  # nothing ahead to compare
                return beside
            agreeing = self._verify_near(keyframe, beside.map_T_cam, row, False).inliers
            beside = dataclasses.replace(beside, others=agreeing)
            found_beside = [beside]
            if self._choose([beside, *found_ahead], "") is beside:
                return beside
        if ahead.reason in ("", "ambiguous") or beside.reason in ("", "ambiguous"):
            closer = self._look_closer(keyframe, [*found_ahead, *found_beside])
            contradicted = any(closer is x for x in found_ahead) and not self._confirmed(closer)
            return not_found("ambiguous", closer.inliers) if contradicted else closer
        return ahead

    def _look_closer(self, keyframe: Keyframe, found: list[Location]) -> Location:
        """Compare places again, each as seen by all keyframes around it, and by what is not everywhere in the map.

        A search counts corners that agree with one keyframe, of which one may lie nearer to a false place than another
        to the true one, and most of which may be lamps and floor tiles. A corner's weight is the square of its word's
        idf in this map, as in a scalar product of tf-idf vectors (Sivic and Zisserman, ICCV 2003).
        """
        places: list[Location] = []
        for place in sorted((x for x in found if x.found), key=lambda x: -x.agreeing):
            if len(places) < CLOSER_PLACES and all(_distinct(place, other) for other in places):
                places.append(place)
        weights: list[F64] = []  # (N,) of each row of a view: of corners by how rare their words are, of points zero
        for words, sideways in zip(self._vocabularies, (False, True), strict=True):
            view = self._view(keyframe, sideways)
            weights.append(np.where(view.corner, words.idf[words.look_up(view.descriptors)] ** 2, 0.0))
        evidence = [self._evidence(keyframe, weights, place) for place in places]
        order = np.argsort(-np.array(evidence), kind="stable").tolist()
        if len(order) > 1 and evidence[order[1]] > RIVAL * evidence[order[0]]:
            return not_found("ambiguous", places[order[0]].inliers)
        if not order or evidence[order[0]] < CLOSER_SHARE * sum(float(w.sum()) for w in weights):
            return not_found("ambiguous")
        return places[order[0]]

    def _evidence(self, keyframe: Keyframe, weights: list[F64], place: Location) -> float:
        """Weight of the corners ahead and beside that agree with a place, from any of the keyframes around it."""
        agreeing = [np.zeros(len(weight), bool) for weight in weights]
        for row in self._nearest(place.map_T_cam, CLOSER_VIEWS).tolist():
            for agrees, sideways in zip(agreeing, (False, True), strict=True):
                agrees[self._verify_near(keyframe, place.map_T_cam, row, sideways).rows[:, 1]] = True
        return sum(float(weight[agrees].sum()) for weight, agrees in zip(weights, agreeing, strict=True))

    def _refined(self, keyframe: Keyframe, place: Location) -> Location:
        """The pose from all that agrees with it ahead and beside, as the nearest keyframe of the map sees it."""
        row = int(self._nearest(place.map_T_cam, 1)[0])
        parts: list[Matches] = []
        for sideways in (False, True):
            rows_a, rows_b = self._verify_near(keyframe, place.map_T_cam, row, sideways).rows.T
            parts.append(pair(self._view(keyframe, sideways), self._cloud(row, sideways), rows_b, rows_a))
        together = joined(parts)
        if len(together.points_a) < self.config.min_inliers:
            return place
        b_T_a = se3.inverse(place.map_T_cam) @ self.map.map_T_kf[row]
        pose = refine_pose(b_T_a, together, self._rig, self.config.sigma_px)
        map_T_cam = self.map.map_T_kf[row] @ se3.inverse(pose.b_T_a)
        refined = dataclasses.replace(place, map_T_cam=map_T_cam, information=pose.information)
        return place if _distinct(place, refined) else refined

    def _confirmed(self, ahead: Location) -> bool:
        """Whether the shelves beside do not contradict what is ahead: rows of lamps look alike from both directions."""
        return ahead.confident or ahead.others < 0 or ahead.others >= self._side_inliers

    def _with_beside(self, keyframe: Keyframe, row: int, ahead: Location) -> Location:
        """What the shelves beside say to a pose found ahead: rows of lamps look alike one lamp further on, too."""
        if len(keyframe.sides) < MIN_CORNERS:
            return dataclasses.replace(ahead, confident=ahead.confident and not self._has_sides)
        cloud = self._cloud(row, True)
        if cloud.corner.sum() < MIN_CORNERS:
            return ahead
        beside = self._verify_near(keyframe, ahead.map_T_cam, row, True).inliers
        share = (ahead.inliers + beside) / (len(keyframe.corners) + len(keyframe.sides))
        return dataclasses.replace(ahead, others=beside, confident=ahead.confident and share >= CONFIDENT_SHARE)

    def _search(self, keyframe: Keyframe, sideways: bool) -> tuple[list[Location], str]:
        """Places by its corners, or by those of the views that face the shelves; and why there are none."""
        config, view = self._config_of(sideways), self._view(keyframe, sideways)
        bag = self._vocabularies[sideways].bag((keyframe.sides if sideways else keyframe.corners).descriptors)
        found: list[Location] = []
        reason = "no_candidate"
        for row in self._places(self._databases[sideways].scores(bag)):
            rng = np.random.default_rng([config.seed, row])
            verdict = verify(view, self._cloud(row, sideways), self._rig, config, rng, move_points=False)
            if verdict.reason:
                reason = verdict.reason if reason == "no_candidate" else reason
                continue
            place = self._location(row, verdict, config.relocalize_share, sideways)
            found.append(place if sideways else self._with_beside(keyframe, row, place))
            if found[-1].confident and not sideways:
                break
        return found, reason

    def locate_near(self, keyframe: Keyframe, guess: F64) -> Location:
        """As `locate`, but only around a predicted map_T_cam (4, 4)."""
        ahead = self._search_near(keyframe, guess, int(self._nearest(guess, 1)[0]), False)
        if ahead.found or len(keyframe.sides) < MIN_CORNERS:
            return ahead
        rows = self._fronts.turned(front_of(keyframe), se3.inverse(guess) @ self.map.map_T_kf)
        beside = self._search_near(keyframe, guess, rows[0], True) if len(rows) else ahead
        return beside if beside.found else ahead

    def _search_near(self, keyframe: Keyframe, guess: F64, row: int, sideways: bool) -> Location:
        verdict = self._verify_near(keyframe, guess, row, sideways)
        if verdict.reason:
            return not_found(verdict.reason, verdict.inliers)
        return self._choose([self._location(row, verdict, self._near_share, sideways)], "")

    def _verify_near(self, keyframe: Keyframe, guess: F64, row: int, sideways: bool) -> Verdict:
        """Match a keyframe with a row's cloud around a predicted map_T_cam (4, 4)."""
        kf_T_cam, view = se3.inverse(guess) @ self.map.map_T_kf[row], self._view(keyframe, sideways)
        return verify_near(kf_T_cam, view, self._cloud(row, sideways), self._rig, self._config_of(sideways))

    def _view(self, keyframe: Keyframe, sideways: bool) -> PlaceView:
        return place_view_of(keyframe, self._rig, self.config.disparity_sigma_px, sideways, self.camera)

    def _config_of(self, sideways: bool) -> LoopConfig:
        return self._side_config if sideways else self.config

    def _gather(self, row: int, sideways: bool) -> Cloud:
        """The points of a keyframe row and its neighbours, in its camera frame."""
        shared = (self._seen[[row]] @ self._sees).toarray()[0]  # points that each keyframe shares with this one
        shared[~self._described] = 0
        shared[row] = shared.max() + 1
        order = np.argsort(-shared, kind="stable")[: 1 + CLOUD_KEYFRAMES]
        order = order[shared[order] > 0]
        centre, *others = (self._keyframes[k] for k in order.tolist())
        own = [self._own[k] for k in order.tolist()]
        cloud = gather(centre, others, self._rig, self.config.disparity_sigma_px, sideways, own)
        mapped = cloud.ids >= 0
        at = np.searchsorted(self.map.pt_ids, cloud.ids[mapped])
        sigmas = cloud.sigmas.copy()
        sigmas[mapped] = np.maximum(sigmas[mapped] / np.sqrt(self._views[at]), MIN_RANGE_SIGMA_M)
        return dataclasses.replace(cloud, sigmas=sigmas)

    def _places(self, scores: F64) -> list[int]:
        """The best rows, each of another place; the score of a place includes its temporal neighbours."""
        best = np.argsort(-with_neighbours(scores), kind="stable")
        scored = best[np.logical_and.accumulate(scores[best] > 0)]
        return apart(scored.tolist(), 2, PLACES)

    def _nearest(self, guess: F64, count: int) -> I64:
        """Rows of the nearest keyframes, nearest first."""
        rows = np.flatnonzero(self._described if self._described.any() else ~self._described)
        metres, radians = se3.extent(se3.inverse(self.map.map_T_kf[rows]) @ guess)
        return rows[np.argsort(metres + radians, kind="stable")[:count]]

    def _location(self, row: int, verdict: Verdict, share: float, sideways: bool) -> Location:
        """The location of a verification, confident with twice what is required.

        `share`: of the camera's corners, required but from another direction.
        """
        least = SIDE_FACTOR * self._side_inliers if sideways else self.config.relocalize_inliers
        share = 0.0 if sideways else share
        map_T_cam = self.map.map_T_kf[row] @ se3.inverse(verdict.b_T_a)
        kf_id = int(self.map.kf_ids[row])
        enough, confident = (verdict.inliers >= times * least and verdict.share >= times * share for times in (1, 2))
        reason = "" if enough else "too_few_inliers"
        return Location(reason, map_T_cam, verdict.information, kf_id, verdict.inliers, verdict.pairs, confident)

    def _choose(self, found: list[Location], reason: str) -> Location:
        """The location with most agreeing corners, if they suffice and no other place is comparable.

        `reason`: why there is none.
        """
        if not found:
            return not_found(reason)
        best = max(found, key=lambda x: x.agreeing)
        if best.reason:
            return not_found(best.reason, best.inliers)
        for other in found:
            if _distinct(best, other) and other.agreeing > RIVAL * best.agreeing:
                return not_found("ambiguous", best.inliers)
        return best
