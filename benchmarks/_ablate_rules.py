"""The rules of the core that `benchmarks ablate` switches off, each by an edit of the source."""

from __future__ import annotations

from dataclasses import dataclass

FLOW = "tracking/flow/"
LOSS = f"{FLOW}loss.py"
SOLVER, TRACKER, MARKS = f"{FLOW}frame_pose.py", f"{FLOW}tracker.py", f"{FLOW}consensus.py"
RECOVERY, STEREO, FOLLOWER = f"{FLOW}recovery.py", f"{FLOW}stereo.py", f"{FLOW}follower.py"
CLOSER, MAPPER = "loop/closer.py", "mapping/mapper.py"


@dataclass(frozen=True)
class Rule:
    """One rule, and what the source is without it."""

    name: str
    edits: tuple[tuple[str, str, str], ...]  # file below stereo_sfm, text (once in the file), what replaces it


def _rule(name: str, file: str, old: str, new: str) -> Rule:
    return Rule(name, ((file, old, new),))


RULES = (
    # The mixture of motions.
    _rule(
        "influence of new points",
        SOLVER,
        "contradicted = self._contradicted(tracks, expected, best)",
        "contradicted = None",
    ),
    _rule("leverage points", SOLVER, "best = self._without_leverage_points(tracks, expected, static, best)", "pass"),
    _rule(
        "motion of long-static points",
        SOLVER,
        "found = [agreed, by_surest, other, by_near]",
        "found = [agreed, other, by_near]",
    ),
    _rule(
        "motion of far points",
        SOLVER,
        "if np.count_nonzero(static & surest) < self._config.min_features:  # who",
        "if False:  # who",
    ),
    _rule(
        "motion of points near the prediction",
        SOLVER,
        "found = [agreed, by_surest, other, by_near]",
        "found = [agreed, by_surest, other]",
    ),
    _rule(
        "motion of the rest",
        SOLVER,
        "found = [agreed, by_surest, other, by_near]",
        "found = [agreed, by_surest, by_near]",
    ),
    _rule(
        "unusual motion is doubted",
        SOLVER,
        "if undisturbed and usual and not self.alert:",
        "if undisturbed and not self.alert:",
    ),
    _rule("few points of an open view", SOLVER, "if not few or (usual and not disturbed):", "if True:"),
    _rule(
        "confirmed by the map", SOLVER, "if undisturbed and self._confirmed(best,", "if False and self._confirmed(best,"
    ),
    _rule("confirmed by known points", SOLVER, "if usual and self._confirmed(chosen, known, MIN_GROUP):", "if False:"),
    _rule("implausible motion", SOLVER, "and self._plausible(s.pose, expected)]", "]"),
    _rule("evidence of its own", SOLVER, "and not self._plausible(agreed.pose, expected)", "and False"),
    _rule(
        "consistent points",
        SOLVER,
        'return best if consistent or not self.alert else no_pose(len(tracks), "no_consensus")',
        "return best",
    ),
    _rule(
        "age of points in the support",
        SOLVER,
        "agree = float((weight * solution.agreement)",
        "agree = float(solution.agreement",
    ),
    _rule(
        "likelihood of motion in the support",
        SOLVER,
        "return agree * self._likelihood(solution.pose, expected)",
        "return agree",
    ),
    _rule(
        "alert for a second",
        SOLVER,
        "STATIC_S if moving else max(self._alert_s - seconds, 0.0)",
        "STATIC_S if moving else 0.0",
    ),
    _rule(
        "prior of long-static and near points",
        SOLVER,
        "self._optimise(tracks, expected, by, expected)",
        "self._optimise(tracks, expected, by)",
    ),
    _rule("prior in the refit", SOLVER, "agree, expected)\n", "agree)\n"),
    _rule("start at rest", SOLVER, "if best.inliers < 0.5 * np.count_nonzero(static):", "if False:"),
    _rule("noise is learned", SOLVER, "self._learn_noise(tracks, solution, seconds)\n        if", "if"),
    _rule(
        "noise of long-static points",
        SOLVER,
        "if np.count_nonzero(surely_static) < 2 * self._config.min_features:",
        "if True:",
    ),
    _rule("moving points are marked", TRACKER, "MAX_MISSES, self._solver.alert, static)", "MAX_MISSES, False, static)"),
    _rule(
        "new points beside moving ones",
        MARKS,
        "return np.where(count >= least, np.ceil(mean), 0).astype(np.int32)",
        "return np.zeros(len(uv), np.int32)",
    ),
    _rule("disagreement outweighs", MARKS, "DISAGREES = 2", "DISAGREES = 1"),
    _rule(
        "groups among neighbours",
        MARKS,
        "return _marked_neighbours(tracks, points, points) > NEIGHBOURS // 2",
        "return points",
    ),
    _rule(
        "places of lost movers",
        MARKS,
        "lost = before.disagreed & ~np.isin(before.point_ids, after.point_ids)",
        "lost = before.disagreed & False",
    ),
    _rule(
        "corners on moving objects",
        MARKS,
        "static = movers.near(corners.uv_left.astype(np.float64), 1.0 / np.maximum(distance, 1e-6), tracks) == 0",
        "static = np.ones(len(distance), bool)",
    ),
    _rule("new points in each crowded image", TRACKER, "or self._solver.crowded(self._static_count())", ""),
    # The motion filter.
    _rule(
        "learned limits of motion",
        SOLVER,
        "quadratic = np.maximum(quadratic, LIMIT_SIGMAS * np.sqrt(self._difference))",
        "pass",
    ),
    _rule(
        "learned differences of motion",
        SOLVER,
        "np.maximum(quadratic, factor * np.sqrt(self._difference))",
        "quadratic",
    ),
    _rule(
        "steady motion",
        TRACKER,
        "self._recovery.motion.steady(image.stamp_ns) if bridge is None else None",
        "None",
    ),
    _rule("other motions are tried", RECOVERY, "if self.unobstructed and expected.sigma_m > UNCERTAIN_M:", "if False:"),
    _rule(
        "velocity after recovery",
        TRACKER,
        "if recovered or not timed:\n            self._velocity",
        "if False:\n            self._velocity",
    ),
    _rule("robot at rest", "tracking/inertial/rest.py", "if not still or not sensors_still():", "if True:"),
    # The relocalizer.
    _rule(
        "more of an occluded view",
        TRACKER,
        "if not self._part.wanted(self._follower.reference, image.stamp_ns):\n            return None",
        "return None",
    ),
    _rule(
        "the better reference image",
        FOLLOWER,
        "if self._reference is None or self._in_view(image, later) >= self._in_view(self._reference, later):",
        "if True:",
    ),
    _rule("more reference points", TRACKER, "        self._add_to_reference()\n        bridge", "        bridge"),
    _rule(
        "recall by distance from the prediction",
        RECOVERY,
        "return MIN_RECALL * (1.0 + off) + RECALL_PER_METRE * min(prediction.sigma_m, MAX_SIGMA_M)",
        "return MIN_RECALL",
    ),
    _rule(
        "rival places after a loss",
        RECOVERY,
        "return None if any(recall > RIVAL * best[2] for recall in rivals) else best",
        "return best",
    ),
    _rule("cells per metre", TRACKER, "CELLS_PER_METRE * expected.sigma_m)", "1.0)"),
    _rule(
        "occluded cells do not count",
        TRACKER,
        "self._follower.recall(found_again, solution.pose, seen, ",
        "self._follower.recall(found_again, solution.pose, None, ",
    ),
    _rule(
        "share of an unobstructed view",
        RECOVERY,
        "self.unobstructed = bool(np.minimum(self._occupied(corners), self._rows).sum() >= OPEN_SHARE * self._cells)",
        "self.unobstructed = True",
    ),
    _rule(
        "rows of an unobstructed view",
        RECOVERY,
        "np.minimum(self._occupied(corners), self._rows).sum()",
        "self._occupied(corners).sum()",
    ),
    _rule(
        "occluded time counts a tenth",
        LOSS,
        "max(self._unobstructed_s, OCCLUDED_SHARE * self._occluded_s)",
        "self._unobstructed_s",
    ),
    _rule(
        "recent places",
        RECOVERY,
        "candidates = self._places.find(seen, expected.odom_T_cam)",
        "candidates: list[F64] = []",
    ),
    _rule(
        "a trusted pose",
        TRACKER,
        "return agree >= max(TRUSTED_SHARE * int(np.count_nonzero(~tracks.moving)), enough)",
        "return True",
    ),
    _rule("search in three rounds", TRACKER, "for reach, most in ROUNDS:", "for reach, most in ROUNDS[::2]:"),
    _rule("lost second image begins anew", LOSS, "second or max(", "max("),
    _rule("blurred images", TRACKER, "return blurred if consistent else (tracks, solution)", "return tracks, solution"),
    _rule(
        "rotation of the whole image",
        TRACKER,
        "for anywhere in (False, True):",
        "turned = expected\n        for anywhere in ():",
    ),
    _rule("rotation from anywhere", TRACKER, "for anywhere in (False, True):", "for anywhere in (False,):"),
    # Windows and stereo.
    _rule("tests give way", STEREO, "good = failed < self._gives_way(failed, needed)", "good = failed < 1.0"),
    _rule("the match back", STEREO, "off[np.isnan(off)] = np.inf", "off[:] = 0.0"),
    _rule(
        "a narrower window",
        STEREO,
        "np.maximum(np.linalg.norm(back - uv, axis=1), np.linalg.norm(narrow - uv_right, axis=1))",
        "np.linalg.norm(back - uv, axis=1)",
    ),
    _rule(
        "noise of a match",
        STEREO,
        "np.maximum(off / EDGE_DIFFERENCE, sigma_px / EDGE_SIGMAS) / self._sigma_px",
        "off / EDGE_DIFFERENCE / self._sigma_px",
    ),
    _rule(
        "residual of a plane",
        STEREO,
        "failed = np.maximum(failed, misfit / (EDGE_MISFIT * typical))",
        "pass",
    ),
    _rule(
        "tracked windows on one surface",
        STEREO,
        "fitted[failed >= 1.0] = np.nan",
        "fitted[~np.isfinite(failed)] = np.nan",
    ),
    _rule("learned noise of matches", STEREO, "if off is not None and tested.any():", "if False:"),
    _rule(
        "epipolar plane", f"{FLOW}epipolar_gate.py", "        self._plane = plane\n", "        plane = self._plane\n"
    ),
    _rule(
        "offset from the curve", f"{FLOW}tracks.py", "return self.uv_right - self.right_offset", "return self.uv_right"
    ),
    _rule(
        "corners on edges", f"{FLOW}corners.py", "if u >= 0 and not edges and _lies_on_edge(image, u, v):", "if False:"
    ),
    _rule("quadratic warps", FOLLOWER, "return out\n\n    def _align(", "return 0.0 * out\n\n    def _align("),
    _rule(
        "alignment without translation",
        FOLLOWER,
        "near = np.full(len(guess), self._miss_px < ALIGNED_PX)",
        "near = np.zeros(len(guess), bool)",
    ),
    _rule("rim of the lens", f"{FLOW}visible_area.py", "if self._degree[0, 0] < MIN_RIM_DEG:", "if True:"),
    # Keyframes and the map.
    _rule(
        "spacing of described keyframes",
        f"{FLOW}keyframes.py",
        "return bool(metres >= SPACING[0] * distance or radians >= SPACING[1])",
        "return True",
    ),
    _rule(
        "points go on after a correction",
        TRACKER,
        "if not solution.reason and solution.consistent:\n            self._resumed",
        "if False:\n            self._resumed",
    ),
    _rule(
        "redundant keyframes",
        MAPPER,
        "redundant = culling.redundant_keyframe(self.map, row, protected, earlier, self._config)",
        "redundant = -1",
    ),
    _rule(
        "repeated views",
        MAPPER,
        "passed = self._one_too_many() if redundant < 0 and self._config.redundant_share <= 1 else -1",
        "passed = -1",
    ),
    _rule(
        "weak points",
        MAPPER,
        "weak = culling.weak_points(self.map, self.rig, rows, row, self._config)",
        "weak = rows[:0]",
    ),
    _rule("triangulated anew", MAPPER, "self.map.move_points(recent, triangulate(self.map, self.rig, recent))", "pass"),
    # Loops.
    _rule("rival loops", CLOSER, "if any(self._rivals(h, loop, support) for h in self._pending):", "if False:"),
    _rule(
        "places that looked alike",
        CLOSER,
        "if loop.anywhere and not loop.sideways and self._looked_alike(loop, max(support.values())):",
        "if False:",
    ),
    _rule("loops against odometry", CLOSER, 'against = "" if near else "against_odometry"', 'against = ""'),
    _rule(
        "votes for a loop",
        CLOSER,
        'return "" if len(self._support(loop, self._config.consistent_window)) >= loop.votes else "not_confirmed_yet"',
        'return ""',
    ),
    _rule(
        "support across a gap",
        CLOSER,
        "enough = loop.votes == 1 or loop.sideways or self._total(support) >= 2 * (CONFIDENT_SHARE - self._chance)",
        "enough = True",
    ),
    _rule("a better loop elsewhere", CLOSER, "if loop.inliers < RIVAL * best_inliers:", "if False:"),
    _rule("points move in the last step of a loop", "loop/verification.py", "    if move_points:\n", "    if False:\n"),
    # The rig.
    _rule(
        "rotation of the right camera in one image",
        f"{FLOW}sudden_turn.py",
        "return SuddenTurns() if corrects and rig.second_camera is not None else None",
        "return None",
    ),
)
