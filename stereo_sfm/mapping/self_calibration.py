"""Self-calibration: corrections of the rig estimated from the keyframes during mapping.

Every few keyframes with motion form a window (`mapping.rig_window`); the information of the windows about the six terms
is summed. Terms are corrected that differ from the current ones by several standard deviations, that both halves of the
windows (even and odd ones) confirm, and that exceed the systematic error of matching (`calib.choice`). A corrected term
is refined whenever the number of windows has doubled, and at the end. If the newest windows contradict all earlier
ones, the rig has changed (a knock, drift): the earlier windows are discarded, and the correction applies from there on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.choice import NAMES, SCALES, TERMS, UNITS, Choice, Estimate, choose
from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.mapping.rig_window import PRIOR, RigInformation, RigWindow, solve_window
from stereo_sfm.types import F64, Keyframe

KEYFRAMES = 4  # of one window
MIN_KEYFRAMES = 3  # of the last window
MIN_MOTION = 0.02  # of the image's width: median motion of common points from one keyframe of a window to the next
MAX_COMMON = 0.6  # share of common points below which a keyframe has moved in any case
FIRST_WINDOWS = 4  # before the first correction
MIN_WINDOWS = 2  # at the end of a run
MAX_WINDOWS = 40  # used
RECENT = 2  # windows that must contradict all others to indicate a step
BEFORE_STEP = 4  # earlier windows needed to detect a step
SIGMAS = 5.0  # significance of the first correction of a term
REFINED_SIGMAS = 2.5  # significance of its refinement
MATCHING_PX = 0.02  # systematic error of matching
DIRECTION = np.deg2rad(0.15)  # systematic error of the baseline's direction: matching errors that depend on distance


@dataclass(frozen=True, eq=False)
class Revision:
    """New terms from a keyframe on."""

    terms: F64  # (6,) added to the calibrated rig
    covariance: F64  # (6, 6)
    since_kf_id: int  # first keyframe of the corrected rig
    why: str  # "significant", "step", "refined"
    text: str  # readable description


class SelfCalibration:
    """Estimates revisions of the rig's terms from the keyframes of a run, in order."""

    def __init__(self, rig: Rig, applies: bool = True) -> None:
        """`rig`: the calibrated rig, two cameras. `applies`: revisions change the rig of the run."""
        self._rig, self.applies = rig, applies
        self.terms: F64 = np.zeros(TERMS)  # current corrections
        self._corrected = np.zeros(TERMS, bool)
        self._keyframes: list[Keyframe] = []
        self._windows: deque[RigWindow] = deque(maxlen=MAX_WINDOWS)  # since the last step
        self._since = 0  # keyframe of the last step
        self._due = FIRST_WINDOWS
        self._stepped = False  # a step was detected and is not yet corrected
        half_width = 0.5 * rig.left.width
        turn = MATCHING_PX / rig.left.fx
        roll = ratio = MATCHING_PX / (0.5 * half_width)
        self._floor = np.array([turn, turn, roll, DIRECTION, DIRECTION, ratio])

    def add(self, keyframe: Keyframe) -> Revision | None:
        """Add a keyframe; returns a revision when one becomes significant."""
        if self._keyframes and keyframe.submap_id != self._keyframes[0].submap_id:
            self._keyframes = []
        if self._keyframes and not _moved(self._keyframes[-1], keyframe, MIN_MOTION * self._rig.left.width):
            return None
        self._keyframes.append(keyframe)
        if len(self._keyframes) < KEYFRAMES or not self._close_window():
            return None
        due = len(self._windows) >= self._due or self._stepped
        return self._revise() if due else None

    @staticmethod
    def wanted(config: Config, rig: Rig) -> SelfCalibration | None:
        """The self-calibration of a run, None if it is off or the rig has one camera."""
        mode, flow = config.self_calibration.mode, config.odometry.method == "flow"
        if mode == "off" or not flow or rig.right is None or rig.depth:
            return None
        return SelfCalibration(rig, mode == "auto")

    def finish(self) -> Revision | None:
        """After the last keyframe: a last revision from all windows."""
        if len(self._keyframes) >= MIN_KEYFRAMES:
            self._close_window()
        return self._revise() if len(self._windows) >= MIN_WINDOWS else None

    def estimate(self, windows: Sequence[RigWindow]) -> Estimate:
        """Change of the current terms estimated from windows; its covariance includes systematic matching errors."""
        none = RigInformation(np.diag(1 / PRIOR**2), self.terms / PRIOR**2)
        total = sum((w.information for w in windows), none)
        covariance = np.asarray(np.linalg.inv(total.matrix), float)
        return Estimate(covariance @ total.vector - self.terms, covariance + np.diag(self._floor**2))

    def _close_window(self) -> bool:
        """Add a window of the collected keyframes; False if they do not determine one."""
        window = solve_window(self._rig, self._keyframes, self.terms)
        self._keyframes = []
        if window is not None:
            self._windows.append(window)
            self._detect_step()
        return window is not None

    def _revise(self) -> Revision | None:
        windows = list(self._windows)
        sigmas = np.where(self._corrected, REFINED_SIGMAS, SIGMAS)
        choice = choose(
            self.estimate(windows),
            [self.estimate(windows[half::2]) for half in (0, 1)],
            self._rig.readout_s > 0,
            sigmas,
        )
        self._due = max(self._due, 2 * len(windows))
        if not choice.written.any():
            return None
        why = "step" if self._stepped else "refined" if self._corrected[choice.written].all() else "significant"
        self.terms = self.terms + choice.value
        self._corrected |= choice.written
        self._stepped = False
        whole = self.estimate(windows)
        return Revision(self.terms.copy(), whole.covariance, self._since, why, _text(choice))

    def _detect_step(self) -> None:
        windows = list(self._windows)
        before, recent = windows[:-RECENT], windows[-RECENT:]
        if len(before) < BEFORE_STEP:
            return
        base = self.estimate(before)
        change = [_difference(self.estimate(part), base) for part in (recent, recent[:1], recent[1:])]
        if choose(change[0], change[1:], self._rig.readout_s > 0, SIGMAS).written.any():
            self._windows = deque(recent, maxlen=MAX_WINDOWS)
            self._since, self._due, self._stepped = recent[0].first_kf_id, FIRST_WINDOWS, True


def _difference(after: Estimate, before: Estimate) -> Estimate:
    return Estimate(after.value - before.value, after.covariance + before.covariance)


def _moved(a: Keyframe, b: Keyframe, min_px: float) -> bool:
    """Whether common points moved by `min_px` (median), or many points were lost (the remaining ones are far)."""
    _, at, of = np.intersect1d(a.point_ids, b.point_ids, return_indices=True)
    if len(at) < MAX_COMMON * len(a.point_ids):
        return True
    return bool(np.median(np.linalg.norm(a.uv_left[at] - b.uv_left[of], axis=1)) > min_px)


def _text(choice: Choice) -> str:
    parts = [
        f"{NAMES[i]} {SCALES[i] * choice.value[i]:+.3f} +- {SCALES[i] * choice.sigma[i]:.3f} {UNITS[i]}"
        for i in np.flatnonzero(choice.written)
    ]
    return "; ".join(parts)
