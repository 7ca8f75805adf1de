"""Self-calibration: corrections of the rig estimated from the keyframes during mapping.

Every few keyframes with motion form a window (`rig_window`). The terms of the rig are estimated from all windows with
the deviations that the windows' scatter shows (`rig_course`). Terms are corrected that differ from the current ones by
several of these, that both halves of the windows (even and odd ones) confirm, and whose correction by one half makes
rows and reprojections of the other half better. Once one is, others follow that are likely wrong. The rows show terms
of lenses, which change lengths by what the lens model says of disparities: lengths stay unless there is evidence about
them. A corrected term is refined as long as windows come, first whenever their number has doubled; one that moves by
more than its deviation allowed, and then is not significant any more, is taken back for good. Points are tracked where
a wrong rig expects them, and agree with it a little: once there are enough windows since a large correction, those
before it are discarded. Where the windows show drift (temperature), the rig is known to be wrong: the terms at the
newest window are used from it on, and the windows since the last revision are on the way there.

A sudden rotation of the right camera is noticed and measured by the tracker (`tracking.flow.sudden_turn`). Once it has
stayed for some keyframes, which are better explained by it, the rig is corrected by it from the first of these on, and
what the windows before it showed of the rig goes on to hold for the rig so turned.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.choice import NAMES, SCALES, SIGMAS, UNITS, Estimate, choose, significant
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calibration.rig_course import constant, steady
from stereo_sfm.calibration.rig_window import LENSES, RigWindow, SeenPoints, solve_window
from stereo_sfm.config import Config
from stereo_sfm.types import F64, RIG_TERMS, Bool, CalibrationUpdate, Keyframe

KEYFRAMES = 4  # of one window, the last one may have one less; a rotation that the tracker noticed stays for as many
# Share of the image's width that common points move (median) between keyframes of a window: less says little.
MIN_MOTION = 0.02
MAX_COMMON = 0.6  # share of common points below which a keyframe has moved in any case: near ones left the view
MIN_WINDOWS = 2  # before the first correction: one for each half
# Windows that each term needs, in the order in which cameras err: rotation, baseline and focal length, decentering.
INTRODUCED = np.array([1, 1, 1, 2, 2, 2, 4, 4])
# For halves of two windows each, twice as many for drift, of which two are unknown. As many as there are, but no more
# than these, come from one revision to the next.
ENOUGH_WINDOWS = 4
MAX_WINDOWS = 80  # used, the newest: what changes slowly is followed
# Of others, once the calibration is known to be wrong: Akaike's criterion, but for those by which cameras err least.
FURTHER_SIGMAS = np.where(np.isin(np.arange(RIG_TERMS), [3, 4, 6, 7]), SIGMAS, np.sqrt(2.0))
REFINED_SIGMAS = 0.3  # its refinement: below, a change is not worth the bundle adjustment
# Standard deviations, of one in 370 by chance and of one in 44 (one-sided):
HUNTING_SIGMAS = 3.0  # by which a refinement moves a term that is taken back unless it is still significant
HELPING_SIGMAS = 2.0  # by which a correction makes windows better that it was not estimated from
MISLED_SHARE = 0.05  # of a rig's error that remains in what is estimated from points tracked with it
MATCHING_PX = 0.02  # px, systematic error of matching, which all windows share
# Bias of the terms of lenses, px at the border over the noise of a pixel: distances are a nonlinear function of pixels.
BIAS_SHARE = 0.5
WINDOW_PX = 0.05  # px, that of one window, before windows show theirs: of ten real recordings 0.02 to 0.1 in the median
DIRECTION = np.deg2rad(0.15)  # radians, systematic error of the baseline's direction: of matching, by distance


@dataclass(frozen=True, eq=False)
class Revision:
    """New terms from a keyframe on."""

    terms: F64  # (8,) added to the calibrated rig
    covariance: F64  # (8, 8)
    since_kf_id: int  # first keyframe of the corrected rig
    why: str  # "significant", "step", "refined", "drift"
    text: str  # readable description
    on_the_way: tuple[tuple[int, F64], ...] = ()  # of a drift: earlier keyframes and the terms from each of them on

    def message(self, version: int, kf_id: int, stamp_ns: int, applied: bool) -> CalibrationUpdate:
        """As a message, with the map update and the keyframe that bring it."""
        return CalibrationUpdate(
            version, kf_id, stamp_ns, self.terms, self.covariance, self.since_kf_id, applied, self.why, self.text
        )


class SelfCalibration:
    """Estimates revisions of the rig's terms from the keyframes of a run, in order."""

    def __init__(self, rig: Rig, applies: bool = True) -> None:
        """`rig`: the calibrated rig, two cameras. `applies`: revisions change the rig of the run."""
        self._rig, self.applies = rig, applies
        self._rolling = rig.readout_s != 0
        self.terms: F64 = np.zeros(RIG_TERMS)  # current corrections
        self._corrected = np.zeros(RIG_TERMS, bool)
        self._keyframes: list[SeenPoints] = []
        self.windows: deque[RigWindow] = deque(maxlen=MAX_WINDOWS)  # of the rig as it is now turned
        self._since = 0  # first keyframe of the windows
        self._stamp_ns = 0  # newest keyframe
        self._revised_ns = 0  # newest keyframe of the last revision
        self._until_due = MIN_WINDOWS  # windows until the next revision
        self._misled_kf_id = -1  # last keyframe tracked with a rig that a large correction has shown to be wrong
        self._turn: F64 = np.zeros(3)  # that the tracker noticed
        self._turned_kf_id = -1  # first keyframe since; -1: the rig has been corrected
        half_width = 0.5 * max(rig.left.width, rig.left.height)
        turn, roll = 1 / rig.left.fx, 2 / half_width
        decentering = roll * rig.left.fx / half_width
        self._of_pixel = np.array([turn, turn, roll, np.inf, np.inf, roll, decentering, decentering])
        self._expected = np.diag(np.minimum(WINDOW_PX * self._of_pixel, DIRECTION) ** 2)
        self._taken_back = np.zeros(RIG_TERMS, bool)
        self._sigma = np.zeros(RIG_TERMS)  # of the corrections, those of the basis

    def add(self, keyframe: Keyframe) -> Revision | None:
        """Add a keyframe; returns a revision when one becomes significant."""
        seen, self._stamp_ns = SeenPoints.of(keyframe), keyframe.stamp_ns
        self._rolling |= keyframe.readout_s != 0
        turned = self._sudden_turn(keyframe, seen)
        if self._keyframes and seen.submap_id != self._keyframes[0].submap_id:
            self._keyframes = []
        moved = not self._keyframes or _moved(self._keyframes[-1], seen, MIN_MOTION * max(self._rig.left.size))
        if moved:
            self._keyframes.append(seen)
        if not moved or turned is not None or self._turned_kf_id >= 0:
            return turned
        if len(self._keyframes) == 2 and not (self.windows or self._corrected.any()):  # the fewest of a window
            return self._at_first_sight()
        if len(self._keyframes) < KEYFRAMES or not self._close_window():
            return None
        if self._until_due > 0:
            return None
        return self._revise()

    @staticmethod
    def from_config(config: Config, rig: Rig) -> SelfCalibration | None:
        """The self-calibration of a run, None if it is off or the rig has one camera."""
        mode, flow = config.self_calibration.mode, config.odometry.method == "flow"
        if mode == "off" or not flow or rig.second_camera is None:
            return None
        return SelfCalibration(rig, mode == "auto")

    def finish(self) -> Revision | None:
        """After the last keyframe: a last revision from all windows."""
        if len(self._keyframes) >= KEYFRAMES - 1:
            self._close_window()
        return self._revise(refined_sigmas=0.0) if len(self.windows) >= MIN_WINDOWS else None

    def estimate(self, windows: Sequence[RigWindow]) -> Estimate:
        """Change of the current terms estimated from windows; its covariance includes systematic matching errors."""
        return self._beyond(self.terms, constant(windows, self._expected).at([1.0]))

    def _beyond(self, terms: F64, found: Estimate) -> Estimate:
        """The change from `terms`, with errors that all windows share."""
        px = np.full(RIG_TERMS, MATCHING_PX)
        px[LENSES] += BIAS_SHARE * np.mean([w.noise_px for w in self.windows] or [0.0])
        shared = np.minimum(px * self._of_pixel, DIRECTION)
        return Estimate(found.value - terms, found.covariance + np.diag(shared**2), found.freedom)

    def _close_window(self) -> bool:
        """Add a window of the collected keyframes; False if they do not determine one."""
        window = solve_window(self._rig, self._keyframes, self.terms)
        self._keyframes = []
        if window is not None:
            if len(self.windows) == MAX_WINDOWS:
                self._since = max(self._since, self.windows[1].first_kf_id)
            self.windows.append(window)
            self._until_due -= 1
            # Those tracked with a rig that was far off go, once there are enough others.
            later = [w for w in self.windows if w.first_kf_id > self._misled_kf_id]
            if ENOUGH_WINDOWS <= len(later) < len(self.windows):
                self.windows = deque(later, maxlen=MAX_WINDOWS)
        return window is not None

    def _revise(self, refined_sigmas: float = REFINED_SIGMAS) -> Revision | None:
        """`refined_sigmas`: significance of further corrections of a term."""
        windows = list(self.windows)
        drift = self._drift(windows)
        enough = self._corrected.any() or len(windows) >= ENOUGH_WINDOWS
        self._until_due = min(len(windows), ENOUGH_WINDOWS) if enough else 1
        found = self._change(windows, drift, refined_sigmas)
        if found is None:
            return None
        if drift is not None:
            return self._revision(found, "drift", windows[-1].first_kf_id, self._on_the_way(found.value))
        why = "refined" if self._corrected[found.selected].all() else "significant"
        if (MISLED_SHARE * np.abs(found.value) > found.sigma).any():
            self._misled_kf_id = windows[-1].last_kf_id
        return self._revision(found, why, self._since)

    def _at_first_sight(self) -> Revision | None:
        """A correction of an error that is so large that each half of the points of two keyframes shows it."""
        parts = [self._keyframes, *([k.every(2, first) for k in self._keyframes] for first in (0, 1))]
        windows = [w for part in parts if (w := solve_window(self._rig, part, self.terms)) is not None]
        found = self._change(windows[:1], halves=(windows[1:2], windows[2:])) if len(windows) == len(parts) else None
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
        drift: _Drift | None = None,
        refined_sigmas: float = REFINED_SIGMAS,
        halves: tuple[Sequence[RigWindow], Sequence[RigWindow]] | None = None,
    ) -> _Change | None:
        """What windows show to be wrong; None if nothing is.

        Args:
            refined_sigmas: significance of further corrections of a term.
            halves: of the windows; None: even and odd ones.
        """
        halves = halves or (windows[::2], windows[1::2] or windows)  # one window: what a step has left
        basis = self._basis(windows)
        kept = np.asarray(np.linalg.solve(basis, np.where(self._taken_back, 0.0, basis @ self.terms)), float)
        courses = [] if drift else [constant(part, self._expected).at([1.0]) for part in (windows, *halves)]
        ignored = self._taken_back | (len(windows) < INTRODUCED)
        found = drift.at_the_end if drift else courses
        whole, *parts = [self._beyond(kept, f).by(basis).ignoring(ignored) for f in found]
        wrong = drift.terms if drift and not self._corrected.any() else self._corrected.any()
        new = np.where(ignored, np.inf, np.where(wrong, FURTHER_SIGMAS, SIGMAS))
        sigmas, back = np.where(self._corrected, refined_sigmas, new), kept - self.terms
        choice = choose(whole, parts, self._rolling, sigmas, self._corrected)
        if not (drift or self._helps(halves, [p.without(choice.selected).value for p in parts], basis, back)):
            further = np.where(self._corrected, refined_sigmas, np.inf)
            choice = choose(whole, parts, self._rolling, further, self._corrected)
        hunting = self._corrected & (np.abs(choice.value) > HUNTING_SIGMAS * self._sigma)
        hunting &= np.abs(choice.value + basis @ kept) < SIGMAS * choice.sigma
        if hunting.any() and not drift:
            self._taken_back, self._corrected = self._taken_back | hunting, self._corrected & ~hunting
            return self._change(windows, drift, refined_sigmas, halves)
        value = np.asarray(np.linalg.solve(basis, choice.value), float) + back
        covariance = whole.by(np.asarray(np.linalg.inv(basis), float)).covariance
        return _Change(value, choice.sigma, covariance, choice.selected) if value.any() else None

    def _helps(self, halves: Sequence[Sequence[RigWindow]], values: Sequence[F64], basis: F64, back: F64) -> bool:
        """Whether what one half says makes rows and reprojections of the other half's windows better.

        A window's gain is over its standard deviation: windows know unequally much.
        """
        changes = [np.asarray(np.linalg.solve(basis, value), float) + back for value in values]
        gains = np.array([
            w.information.gain(self.terms, change)
            for change, other in zip(changes, halves[::-1], strict=True)
            for w in other
        ])  # fmt: skip
        return bool(gains.mean() > HELPING_SIGMAS * gains.std() / np.sqrt(len(gains) - 1))

    def _sudden_turn(self, keyframe: Keyframe, seen: SeenPoints) -> Revision | None:
        """The revision of a rotation that the tracker noticed, once some keyframes have shown it, too.

        What the windows before it said of the rig goes on to hold, for the rig so turned. If the keyframes since then
        are better explained by the rig as it was, it stays so; those of a robot at rest say nothing else.
        """
        if not np.array_equal(keyframe.right_turn, self._turn):
            self._turn, self._keyframes = keyframe.right_turn, []
            self._turned_kf_id = keyframe.kf_id if self._turn.any() else -1
        if self._turned_kf_id < 0 or keyframe.kf_id < self._turned_kf_id + KEYFRAMES - 1:
            return None
        change, covariance = np.zeros(RIG_TERMS), np.zeros((RIG_TERMS, RIG_TERMS))
        change[:3] = self._turn
        since = [k for k in [*self._keyframes, seen] if k.submap_id == seen.submap_id][-KEYFRAMES:]
        window = solve_window(self._rig, since, self.terms) if len(since) >= KEYFRAMES - 1 else None
        before = constant(self.windows, self._expected).at([1.0]).value if self.windows else self.terms
        if window is not None and window.information.gain(before, change) < 0.0:
            self._keyframes, self._turned_kf_id = [], -1
            return None
        covariance[:3, :3] = keyframe.right_turn_covariance
        sigma = np.sqrt(np.diag(covariance))
        self.windows = deque((w.turned(change) for w in self.windows), maxlen=MAX_WINDOWS)
        self._since, self._turned_kf_id = self._turned_kf_id, -1
        found = _Change(change, sigma, covariance, np.abs(change) > SIGMAS * sigma)
        revision = self._revision(found, "step", self._since)
        self._sigma = np.full(RIG_TERMS, np.inf)
        return revision

    def _revision(
        self, change: _Change, why: str, since_kf_id: int, on_the_way: tuple[tuple[int, F64], ...] = ()
    ) -> Revision:
        self.terms = self.terms + change.value
        self._corrected |= change.selected
        self._sigma = change.sigma
        self._revised_ns = self._stamp_ns
        values, sigmas = SCALES * change.value, SCALES * change.sigma
        changed = np.flatnonzero(change.value)
        text = "; ".join(f"{NAMES[i]} {values[i]:+.3f} +- {sigmas[i]:.3f} {UNITS[i]}" for i in changed)
        return Revision(self.terms.copy(), change.covariance, since_kf_id, why, text, on_the_way)

    def _basis(self, windows: Sequence[RigWindow]) -> F64:
        """(8, 8) from the terms to those that are chosen: instead of the rotation `across`, one that changes lengths as
        much as it and the terms of lenses together, so that they stay where it is held. With a rolling shutter
        motion can mimic it (`calib.choice`), and the terms are chosen as they are.
        """
        basis = np.eye(RIG_TERMS)
        length, across = np.mean([w.length for w in windows], axis=0), windows[0].across
        if not self._rolling and abs(length[across]) > 1e-9:
            basis[across, LENSES] = length[LENSES] / length[across]
        return basis

    def _drift(self, windows: Sequence[RigWindow]) -> _Drift | None:
        """What windows show of terms that change steadily; None if none does."""
        if len(windows) < 2 * ENOUGH_WINDOWS:
            return None
        whole = steady(windows, windows, self._expected)
        if whole.at([0.0, 1.0]).reach < SIGMAS:
            return None
        courses = [whole, *(steady(part, windows, self._expected) for part in (windows[::2], windows[1::2]))]
        change, *halves = [c.at([0.0, 1.0]) for c in courses]
        terms = significant(change, halves, self._rolling, SIGMAS)
        return _Drift(terms, [c.with_zero(1, ~terms).at([1.0, 0.0]) for c in courses]) if terms.any() else None


@dataclass(frozen=True, eq=False)
class _Drift:
    """Of terms that change steadily."""

    terms: Bool  # (8,) those that do
    at_the_end: list[Estimate]  # the terms, from all windows and from both halves


@dataclass(frozen=True, eq=False)
class _Change:
    """Of the current terms."""

    value: F64  # (8,)
    sigma: F64  # (8,) of those of the basis
    covariance: F64  # (8, 8)
    selected: Bool  # (8,)


def _moved(a: SeenPoints, b: SeenPoints, min_px: float) -> bool:
    """Whether common points moved by `min_px` (median), or many points were lost (the remaining ones are far)."""
    _, at, of = np.intersect1d(a.point_ids, b.point_ids, assume_unique=True, return_indices=True)
    if len(at) < MAX_COMMON * len(a.point_ids):
        return True
    return bool(np.median(np.linalg.norm(a.uv_left[at] - b.uv_left[of], axis=1)) > min_px)
