"""A rig that corrects itself: which of its terms the keyframes contradict, found while mapping goes on.

Every few keyframes that moved make one window (`mapping.rig_window`), whose information about the six terms adds up.
A correction is made of the terms that are several of their own deviations from what is in force, that windows of both
halves (every other one) show, and that are more than matching itself may err by (`calib.choice`). A term once found
wrong is refined as the evidence doubles, and at the end. When the last windows contradict all before them, the rig was
knocked or has drifted: what is before is forgotten, and the correction counts from there on.
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
LEAST_KEYFRAMES = 3  # of the last one
MOVED = 0.02  # of the image's width: median movement of common points that makes another keyframe of a window
STAYED = 0.6  # share of a keyframe's points that another must have lost some of to be elsewhere
FIRST_WINDOWS = 4  # before anything is corrected
LEAST_WINDOWS = 2  # at the end of a run
MOST_WINDOWS = 40  # that are remembered
RECENT = 2  # windows that must contradict all others to mean a step
BEFORE_STEP = 4  # windows that a step is measured against
SIGMAS = 5.0  # evidence for a term that is as the calibration says
REFINED_SIGMAS = 2.5  # evidence for one that was found wrong before
MATCHING_PX = 0.02  # by which matches of a true rig may err alike all over the image
DIRECTION = np.deg2rad(0.15)  # by which what errs with the distance (slanted ground) may pretend a direction


@dataclass(frozen=True, eq=False)
class Revision:
    """Terms that should be in force from a keyframe on."""

    terms: F64  # (6,) added to the rig as its calibration says
    covariance: F64  # (6, 6)
    since_kf_id: int  # first keyframe that was seen by the rig so corrected
    why: str  # "significant", "step", "refined"
    text: str  # for people


class SelfCalibration:
    """Takes the keyframes of a run in order and says when the rig's terms should change."""

    def __init__(self, rig: Rig, applies: bool = True) -> None:
        """`rig`: two cameras, as its calibration says. `applies`: revisions change the rig of the run."""
        self._rig, self.applies = rig, applies
        self.terms: F64 = np.zeros(TERMS)  # in force
        self._found = np.zeros(TERMS, bool)  # terms that were found wrong
        self._keyframes: list[Keyframe] = []
        self._windows: deque[RigWindow] = deque(maxlen=MOST_WINDOWS)  # since the last step
        self._since = 0  # keyframe of the last step
        self._due = FIRST_WINDOWS
        self._stepped = False  # a step was noticed and is not yet corrected
        half_width = 0.5 * rig.left.width
        turn = MATCHING_PX / rig.left.fx
        roll = ratio = MATCHING_PX / (0.5 * half_width)
        self._floor = np.array([turn, turn, roll, DIRECTION, DIRECTION, ratio])

    def add(self, keyframe: Keyframe) -> Revision | None:
        """One keyframe more; a revision when it completes the evidence for one."""
        if self._keyframes and keyframe.submap_id != self._keyframes[0].submap_id:
            self._keyframes = []
        if self._keyframes and not _moved(self._keyframes[-1], keyframe, MOVED * self._rig.left.width):
            return None
        self._keyframes.append(keyframe)
        if len(self._keyframes) < KEYFRAMES or not self._close_window():
            return None
        due = len(self._windows) >= self._due or self._stepped
        return self._revise() if due else None

    @staticmethod
    def wanted(config: Config, rig: Rig) -> SelfCalibration | None:
        """None for a run that does not correct its rig, or a rig without a second camera."""
        mode, flow = config.self_calibration.mode, config.odometry.method == "flow"
        if mode == "off" or not flow or rig.right is None or rig.depth:
            return None
        return SelfCalibration(rig, mode == "auto")

    def finish(self) -> Revision | None:
        """After the last keyframe: what all the evidence says."""
        if len(self._keyframes) >= LEAST_KEYFRAMES:
            self._close_window()
        return self._revise() if len(self._windows) >= LEAST_WINDOWS else None

    def estimate(self, windows: Sequence[RigWindow]) -> Estimate:
        """The terms as some windows show them, less those in force, with what matching may err by."""
        none = RigInformation(np.diag(1 / PRIOR**2), self.terms / PRIOR**2)
        total = sum((w.information for w in windows), none)
        covariance = np.asarray(np.linalg.inv(total.matrix), float)
        return Estimate(covariance @ total.vector - self.terms, covariance + np.diag(self._floor**2))

    def _close_window(self) -> bool:
        """Whether the keyframes since the last window make one."""
        window = solve_window(self._rig, self._keyframes, self.terms)
        self._keyframes = []
        if window is not None:
            self._windows.append(window)
            self._notice_step()
        return window is not None

    def _revise(self) -> Revision | None:
        windows = list(self._windows)
        sigmas = np.where(self._found, REFINED_SIGMAS, SIGMAS)
        choice = choose(
            self.estimate(windows),
            [self.estimate(windows[half::2]) for half in (0, 1)],
            self._rig.readout_s > 0,
            sigmas,
        )
        self._due = max(self._due, 2 * len(windows))
        if not choice.written.any():
            return None
        why = "step" if self._stepped else "refined" if self._found[choice.written].all() else "significant"
        self.terms = self.terms + choice.value
        self._found |= choice.written
        self._stepped = False
        whole = self.estimate(windows)
        return Revision(self.terms.copy(), whole.covariance, self._since, why, _text(choice))

    def _notice_step(self) -> None:
        windows = list(self._windows)
        before, recent = windows[:-RECENT], windows[-RECENT:]
        if len(before) < BEFORE_STEP:
            return
        base = self.estimate(before)
        change = [_difference(self.estimate(part), base) for part in (recent, recent[:1], recent[1:])]
        if choose(change[0], change[1:], self._rig.readout_s > 0, SIGMAS).written.any():
            self._windows = deque(recent, maxlen=MOST_WINDOWS)
            self._since, self._due, self._stepped = recent[0].first_kf_id, FIRST_WINDOWS, True


def _difference(after: Estimate, before: Estimate) -> Estimate:
    return Estimate(after.value - before.value, after.covariance + before.covariance)


def _moved(a: Keyframe, b: Keyframe, least_px: float) -> bool:
    """Whether the points that both keyframes follow moved, or many are gone: those that stay are the distant ones."""
    _, at, of = np.intersect1d(a.point_ids, b.point_ids, return_indices=True)
    if len(at) < STAYED * len(a.point_ids):
        return True
    return bool(np.median(np.linalg.norm(a.uv_left[at] - b.uv_left[of], axis=1)) > least_px)


def _text(choice: Choice) -> str:
    parts = [
        f"{NAMES[i]} {SCALES[i] * choice.value[i]:+.3f} +- {SCALES[i] * choice.sigma[i]:.3f} {UNITS[i]}"
        for i in np.flatnonzero(choice.written)
    ]
    return "; ".join(parts)
