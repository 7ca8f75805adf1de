"""Self-calibration: corrections of the rig estimated from the keyframes during mapping.

Every few keyframes with motion form a window (`mapping.rig_window`); the information of the windows about the terms
is summed. Terms are corrected that differ from the current ones by several standard deviations, that both halves of
the windows (even and odd ones) confirm, and that exceed the systematic error of matching (`calib.choice`). Once one is,
others follow that are worth their variance. The rows show terms of lenses, which change lengths by what the lens model
says of disparities: lengths stay unless there is evidence about them. A corrected term is refined as long as windows
come, first whenever their number has doubled. Points are tracked where a wrong rig expects them, and agree with it a
little: a first error that is so large that two keyframes show it is corrected at once, and once there are enough
windows since a large correction, those before it are discarded. Where the windows show drift (temperature), the rig is
known to be wrong: the terms at the newest window are used from it on, and the windows since the last revision are on
the way there.

After a sudden change of the rig (a knock) earlier windows are discarded, and the correction applies from the first
keyframe on that was seen by the changed rig. What the rig before it measured of the points that are seen before and
after it is what the changed rig is measured with, besides the windows since. The tracker notices a rotation at once
(`tracking.flow.knock`); other changes, and small ones, show where the newest windows contradict all earlier ones.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.choice import NAMES, NONE, SCALES, UNITS, Estimate, choose, significant, with_terms
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.mapping.rig_change import SeenPoints, first_changed
from stereo_sfm.mapping.rig_drift import steady_change
from stereo_sfm.mapping.rig_window import PRIOR, EarlierRig, RigInformation, RigWindow, solve_window
from stereo_sfm.types import F64, RIG_TERMS, Bool, Keyframe

OF_LENSES = slice(5, 8)  # focal ratio and decentering
KEYFRAMES = 4  # of one window
MIN_KEYFRAMES = 3  # of the last window
MIN_MOTION = 0.02  # of the image's width: median motion of common points from one keyframe of a window to the next
MAX_COMMON = 0.6  # share of common points below which a keyframe has moved in any case
MIN_WINDOWS = 2  # before the first correction
FIRST_KEYFRAMES = 2  # from which a first error is corrected that both halves of their points show ...
FIRST_SIGMAS = 20.0  # ... with this significance: errors of lenses and of tracking may look like smaller ones
ENOUGH_WINDOWS = 4  # with fewer, a correction must be more significant: errors of a window's keyframes are alike
MAX_BETWEEN = 4  # windows from one revision to the next: as many as there are, but no more
MAX_WINDOWS = 80  # used, the newest
AFTER_STEP = range(2, 7)  # newest windows that must contradict all others to indicate a step
STRADDLING_SIGMAS = 2.0  # by which a window during which the rig changed differs from those afterwards
BEFORE_STEP = 4  # earlier windows needed to detect a step
STEP_REACH = 2  # windows before and after the likeliest pair of windows in which it may have happened
RECENT_KEYFRAMES = 64  # among which the first after a step is looked for
ACROSS_STEP = 6, 4  # keyframes before and after it from which the changed rig is measured
KNOCK_KEYFRAMES = 2  # after a rotation that the tracker noticed, from which the changed rig is first measured
DRIFT_WINDOWS = 8  # needed to detect drift
SIGMAS = 5.0  # significance of the first term that is corrected
FURTHER_SIGMAS = np.sqrt(2.0)  # of others, once the calibration is known to be wrong (Akaike's criterion)
REFINED_SIGMAS = 0.3  # its refinement: below, a change is not worth the bundle adjustment
MISLED_SHARE = 0.1  # of a rig's error that remains in what is estimated from points tracked with it
MATCHING_PX = 0.02  # systematic error of matching
DIRECTION = np.deg2rad(0.15)  # systematic error of the baseline's direction: matching errors that depend on distance


@dataclass(frozen=True, eq=False)
class Revision:
    """New terms from a keyframe on."""

    terms: F64  # (8,) added to the calibrated rig
    covariance: F64  # (8, 8)
    since_kf_id: int  # first keyframe of the corrected rig
    why: str  # "significant", "step", "refined", "drift"
    text: str  # readable description
    on_the_way: tuple[tuple[int, F64], ...] = ()  # of a drift: earlier keyframes and the terms from each of them on


class SelfCalibration:
    """Estimates revisions of the rig's terms from the keyframes of a run, in order."""

    def __init__(self, rig: Rig, applies: bool = True) -> None:
        """`rig`: the calibrated rig, two cameras. `applies`: revisions change the rig of the run."""
        self._rig, self.applies = rig, applies
        self.terms: F64 = np.zeros(RIG_TERMS)  # current corrections
        self._corrected = np.zeros(RIG_TERMS, bool)
        self._keyframes: list[SeenPoints] = []
        self.windows: deque[RigWindow] = deque(maxlen=MAX_WINDOWS)  # since the last step
        self._since = 0  # first keyframe of the windows
        self._revised_ns = 0  # newest keyframe of the last revision
        self._until_due = MIN_WINDOWS  # windows until the next revision
        self._misled_kf_id = -1  # last keyframe tracked with a rig that a large correction has shown to be wrong
        self._stepped = False  # a step was detected and is not yet corrected
        self._straddling = False  # it may have happened during the first window
        self._step_between = 0, 0  # keyframes between which it happened
        self._recent: deque[SeenPoints] = deque(maxlen=RECENT_KEYFRAMES)
        self._turn: F64 = np.zeros(3)  # that the tracker noticed
        self._turned_kf_id = -1  # first keyframe since; -1: the rig has been measured
        half_width = 0.5 * rig.left.width
        turn = MATCHING_PX / rig.left.fx
        roll = ratio = MATCHING_PX / (0.5 * half_width)
        decentering = roll * rig.left.fx / half_width
        self._floor = np.array([turn, turn, roll, DIRECTION, DIRECTION, ratio, decentering, decentering])

    def add(self, keyframe: Keyframe) -> Revision | None:
        """Add a keyframe; returns a revision when one becomes significant."""
        seen = SeenPoints.of(keyframe)
        self._recent.append(seen)
        knock = self._knock(keyframe)
        if knock is not None:
            return knock
        if self._keyframes and seen.submap_id != self._keyframes[0].submap_id:
            self._keyframes = []
        if self._keyframes and not _moved(self._keyframes[-1], seen, MIN_MOTION * self._rig.left.width):
            return None
        self._keyframes.append(seen)
        if len(self._keyframes) == FIRST_KEYFRAMES and not (self.windows or self._corrected.any()):
            return self._at_first_sight()
        if len(self._keyframes) < KEYFRAMES or not self._close_window():
            return None
        if self._until_due > 0 and not self._stepped:
            return None
        known = self._stepped or len(self.windows) >= ENOUGH_WINDOWS
        return self._revise(SIGMAS if known else SIGMAS * np.sqrt(ENOUGH_WINDOWS / len(self.windows)))

    @staticmethod
    def wanted(config: Config, rig: Rig) -> SelfCalibration | None:
        """The self-calibration of a run, None if it is off or the rig has one camera."""
        mode, flow = config.self_calibration.mode, config.odometry.method == "flow"
        if mode == "off" or not flow or rig.second_camera is None:
            return None
        return SelfCalibration(rig, mode == "auto")

    def finish(self) -> Revision | None:
        """After the last keyframe: a last revision from all windows."""
        if len(self._keyframes) >= MIN_KEYFRAMES:
            self._close_window()
        return self._revise(SIGMAS, refined_sigmas=0.0) if len(self.windows) >= MIN_WINDOWS else None

    def estimate(self, windows: Sequence[RigWindow]) -> Estimate:
        """Change of the current terms estimated from windows; its covariance includes systematic matching errors."""
        total = self._information(windows)
        covariance = np.asarray(np.linalg.inv(total.matrix), float)
        return Estimate(covariance @ total.vector - self.terms, covariance + np.diag(self._floor**2))

    def _information(self, windows: Sequence[RigWindow]) -> RigInformation:
        """That of windows, and of the prior around the current terms."""
        none = RigInformation(np.diag(1 / PRIOR**2), self.terms / PRIOR**2)
        return RigInformation.summed([none, *(w.information for w in windows)])

    def _close_window(self) -> bool:
        """Add a window of the collected keyframes; False if they do not determine one."""
        window = solve_window(self._rig, self._keyframes, self.terms)
        self._keyframes = []
        if window is not None:
            if len(self.windows) == MAX_WINDOWS:
                self._since = self.windows[1].first_kf_id
            self.windows.append(window)
            self._until_due -= 1
            self._drop_misled()
            self._detect_step()
            self._drop_straddling()
        return window is not None

    def _drop_misled(self) -> None:
        """Discard the windows tracked with a rig that was far off, once there are enough others."""
        later = [w for w in self.windows if w.first_kf_id > self._misled_kf_id]
        if ENOUGH_WINDOWS <= len(later) < len(self.windows):
            self.windows = deque(later, maxlen=MAX_WINDOWS)

    def _revise(self, first_sigmas: float, refined_sigmas: float = REFINED_SIGMAS) -> Revision | None:
        """`first_sigmas`, `refined_sigmas`: significance of the first correction of a term, and of further ones."""
        windows = list(self.windows)
        drift = self._drift(windows)
        enough = self._corrected.any() or len(windows) >= ENOUGH_WINDOWS
        self._until_due = min(len(windows), MAX_BETWEEN) if enough else 1
        found = self._change(windows, first_sigmas, drift, refined_sigmas)
        if found is None:
            return None
        if self._stepped:
            self._since, self._stepped = self._first_after_step(self.terms + found.value), False
            return self._revision(self._measured_across(self._since, found, first_sigmas), "step", self._since)
        if drift is not None:
            return self._revision(found, "drift", windows[-1].first_kf_id, self._on_the_way(found.value))
        why = "refined" if self._corrected[found.written].all() else "significant"
        if (MISLED_SHARE * np.abs(found.value) > self._floor).any():
            self._misled_kf_id = windows[-1].last_kf_id
        return self._revision(found, why, self._since)

    def _at_first_sight(self) -> Revision | None:
        """A correction of an error that is so large that each half of the points of two keyframes shows it."""
        halves = [[k.every(2, first) for k in self._keyframes] for first in (0, 1)]
        windows = [w for half in halves if (w := solve_window(self._rig, half, self.terms)) is not None]
        found = self._change(windows, FIRST_SIGMAS) if len(windows) == len(halves) else None
        if found is None:
            return None
        self._misled_kf_id = self._keyframes[-1].kf_id
        return self._revision(found, "significant", self._since)

    def _on_the_way(self, change: F64) -> tuple[tuple[int, F64], ...]:
        """The windows between the last revision and the newest: first keyframes, and terms that change steadily."""
        begin, end = max(self._revised_ns, self.windows[0].stamp_ns), self.windows[-1].stamp_ns
        between = [w for w in self.windows if begin < w.stamp_ns < end]
        return tuple((w.first_kf_id, self.terms + (w.stamp_ns - begin) / (end - begin) * change) for w in between)

    def _change(
        self,
        windows: Sequence[RigWindow],
        first_sigmas: float,
        drift: _Drift | None = None,
        refined_sigmas: float = REFINED_SIGMAS,
    ) -> _Change | None:
        """What windows show to be wrong; None if nothing is."""
        whole = self.estimate(windows) if drift is None else drift.at_the_end[0]
        drifting = NONE if drift is None else drift.terms
        further = FURTHER_SIGMAS if self._corrected.any() else np.where(drifting, FURTHER_SIGMAS, first_sigmas)
        sigmas = np.where(self._corrected, refined_sigmas, further)
        if whole.reach < sigmas.min():
            return None
        parts = windows[::2], windows[1::2] or windows  # one window: what a step has left
        halves = [self.estimate(part) for part in parts] if drift is None else drift.at_the_end[1:]
        basis, rolling = self._basis(windows), self._rig.readout_s > 0
        choice = choose(whole.by(basis), [h.by(basis) for h in halves], rolling, sigmas, self._corrected)
        if not choice.written.any():
            return None
        value = np.asarray(np.linalg.solve(basis, choice.value), float)
        return _Change(value, choice.sigma, whole.covariance, choice.written)

    def _knock(self, keyframe: Keyframe) -> Revision | None:
        """The revision of a rotation that the tracker noticed, once a few keyframes confirm it."""
        turn = keyframe.right_turn
        if turn.any() and (not self._turn.any() or (self._turned_kf_id < 0 and not np.array_equal(turn, self._turn))):
            self._turned_kf_id = keyframe.kf_id
        self._turn = turn
        after = sum(k.kf_id >= self._turned_kf_id for k in self._recent)
        if not turn.any() or self._turned_kf_id < 0 or not KNOCK_KEYFRAMES <= after <= ACROSS_STEP[1]:
            return None
        initial = self.terms.copy()
        initial[:3] += turn
        across = self._across(len(self._recent) - after, initial)
        found = None if across is None else self._change([across], SIGMAS)
        if across is None or found is None:
            return None
        self._since, self._step_between = self._turned_kf_id, (self._turned_kf_id - STEP_REACH, keyframe.kf_id)
        first = self._first_after_step(self.terms + found.value)
        if first < self._since:  # it was noticed some images late
            self._since, after = first, sum(k.kf_id >= first for k in self._recent)
            again = self._across(len(self._recent) - after, self.terms + found.value)
            across = across if again is None else again
            found = self._change([across], SIGMAS) or found
        self.windows = deque([across], maxlen=MAX_WINDOWS)
        self._keyframes = list(self._recent)[-after:]
        self._stepped = self._straddling = False
        self._turned_kf_id, self._until_due = -1, MIN_WINDOWS
        return self._revision(found, "step", self._since)

    def _revision(
        self, change: _Change, why: str, since_kf_id: int, on_the_way: tuple[tuple[int, F64], ...] = ()
    ) -> Revision:
        self.terms = self.terms + change.value
        self._corrected |= change.written
        self._revised_ns = self._recent[-1].stamp_ns
        text = _text(change.value, change.sigma)
        return Revision(self.terms.copy(), change.covariance, since_kf_id, why, text, on_the_way)

    def _across(self, at: int, terms: F64) -> RigWindow | None:
        """Of the newest keyframes, those from `at` on, measured with what the rig before them knew of their points.

        `terms`: initial ones.
        """
        recent = list(self._recent)
        before, after = recent[max(at - ACROSS_STEP[0], 0) : at], recent[at : at + ACROSS_STEP[1]]
        if not before or any(k.submap_id != before[0].submap_id for k in (*before, *after)):
            return None
        earlier = EarlierRig(with_terms(self._rig, self.terms), len(before))
        return solve_window(self._rig, [*before[::-1], *after], terms, earlier)

    def _measured_across(self, since_kf_id: int, found: _Change, first_sigmas: float) -> _Change:
        """A step's change, measured with what the rig before it knew of the points."""
        at = next((i for i, k in enumerate(self._recent) if k.kf_id == since_kf_id), 0)
        across = self._across(at, self.terms + found.value)
        if across is None:
            return found
        self.windows.appendleft(across)
        self._straddling = False
        return self._change(list(self.windows), first_sigmas) or found

    def _basis(self, windows: Sequence[RigWindow]) -> F64:
        """(8, 8) from the terms to those that are chosen: instead of the rotation about y, the one that changes lengths
        as much as it and the terms of lenses together, so that they stay where it is held. With a rolling shutter
        motion can mimic it (`calib.choice`), and the terms are chosen as they are.
        """
        basis = np.eye(RIG_TERMS)
        length = np.mean([w.length for w in windows], axis=0)
        if self._rig.readout_s == 0 and abs(length[1]) > 1e-9:
            basis[1, OF_LENSES] = length[OF_LENSES] / length[1]
        return basis

    def _drift(self, windows: Sequence[RigWindow]) -> _Drift | None:
        """What windows show of terms that change steadily; None if none does."""
        if len(windows) < DRIFT_WINDOWS:
            return None
        whole = steady_change(windows, windows, self.terms, self._floor)
        if whole.estimate.reach < SIGMAS:
            return None
        halves = [steady_change(part, windows, self.terms, self._floor) for part in (windows[::2], windows[1::2])]
        terms = significant(whole.estimate, [h.estimate for h in halves], self._rig.readout_s > 0, SIGMAS)
        return _Drift(terms, [fit.at_the_end(terms) for fit in (whole, *halves)]) if terms.any() else None

    def _detect_step(self) -> None:
        windows = list(self.windows)
        splits = range(len(windows) - AFTER_STEP.start, max(BEFORE_STEP, len(windows) - AFTER_STEP.stop + 1) - 1, -1)
        if not any(self._differ(windows[:k], windows[k:]) for k in splits):
            return
        split = max(splits, key=lambda k: self._fit(windows[:k]) + self._fit(windows[k:]))
        first = windows[split]
        self.windows = deque(windows[split:], maxlen=MAX_WINDOWS)
        self._since, self._stepped, self._straddling = first.first_kf_id, True, True
        self._step_between = windows[split - STEP_REACH].first_kf_id, windows[split:][:STEP_REACH][-1].last_kf_id

    def _differ(self, before: Sequence[RigWindow], after: Sequence[RigWindow]) -> bool:
        """Whether the newest windows contradict all earlier ones."""
        base = self.estimate(before)
        change = _difference(self.estimate(after), base)
        if change.reach < SIGMAS:
            return False
        halves = [_difference(self.estimate(part), base) for part in (after[::2], after[1::2])]
        return bool(significant(change, halves, self._rig.readout_s > 0, SIGMAS).any())

    def _fit(self, windows: Sequence[RigWindow]) -> float:
        """How well one rig explains windows: their log-likelihood but for a constant of each window."""
        total = self._information(windows)
        return 0.5 * float(total.vector @ np.linalg.solve(total.matrix, total.vector))

    def _first_after_step(self, terms: F64) -> int:
        """Id of the first keyframe that the rig with these terms saw, else of the first window after the step."""
        first, last = self._step_between
        seen = [k for k in self._recent if first <= k.kf_id <= last]
        found = first_changed(seen, with_terms(self._rig, self.terms), with_terms(self._rig, terms))
        return self._since if found is None else found

    def _drop_straddling(self) -> None:
        """After a step, discard the first window if it contradicts the others: the rig changed during it."""
        first, *others = self.windows
        if not self._straddling or not others:
            return
        change = _difference(self.estimate(others), self.estimate([first]))
        if significant(change, [change], self._rig.readout_s > 0, STRADDLING_SIGMAS).any():
            self.windows.popleft()
            self._straddling = False


@dataclass(frozen=True, eq=False)
class _Drift:
    """Of terms that change steadily."""

    terms: Bool  # (8,) those that do
    at_the_end: list[Estimate]  # change of the current terms, from all windows and from both halves


@dataclass(frozen=True, eq=False)
class _Change:
    """Of the current terms."""

    value: F64  # (8,)
    sigma: F64  # (8,) of those of the basis
    covariance: F64  # (8, 8)
    written: Bool  # (8,)


def _difference(after: Estimate, before: Estimate) -> Estimate:
    return Estimate(after.value - before.value, after.covariance + before.covariance)


def _moved(a: SeenPoints, b: SeenPoints, min_px: float) -> bool:
    """Whether common points moved by `min_px` (median), or many points were lost (the remaining ones are far)."""
    _, at, of = np.intersect1d(a.point_ids, b.point_ids, assume_unique=True, return_indices=True)
    if len(at) < MAX_COMMON * len(a.point_ids):
        return True
    return bool(np.median(np.linalg.norm(a.uv_left[at] - b.uv_left[of], axis=1)) > min_px)


def _text(change: F64, sigma: F64) -> str:
    parts = [
        f"{NAMES[i]} {SCALES[i] * change[i]:+.3f} +- {SCALES[i] * sigma[i]:.3f} {UNITS[i]}"
        for i in np.flatnonzero(change)
    ]
    return "; ".join(parts)
