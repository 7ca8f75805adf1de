"""A sudden rotation of the right camera (a knock), noticed in the image in which it happens.

Points whose distances are known predict where both cameras see them. The pose moves both predictions alike; what moves
the right pixels alone, and all of them as one rotation of the right camera would, is such a rotation.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.geometry.kernels import njit, project_one
from stereo_sfm.geometry.small_matrix import solve_symmetric
from stereo_sfm.tracking.flow.consensus import SETTLED_S, STATIC_S
from stereo_sfm.tracking.flow.frame_pose import PoseSolution
from stereo_sfm.tracking.flow.stereo_cameras import StereoCameras
from stereo_sfm.tracking.flow.tracks import Tracks
from stereo_sfm.types import F64

MIN_POINTS, MIN_AGREEING = 35, 0.5  # that are known, seen by both cameras; share of them that must agree
UNDIVIDED = 0.6  # share of them that agree with a pose; where fewer do, the others are used, too
MIN_SHIFT_PX = 0.3  # root mean square over the points
MIN_SHARE = 0.8  # of the squared residuals that one rotation must explain
FIRST_SCALE_PX, STEPS, SCALE = 3.0, 4, 3.0  # of the robust estimate; its scale over the rest that the rotation leaves
SUDDEN = 0.5  # share of a rotation that the last images did not show yet: a rig may be wrong from the start
UNCONFIRMED_S = 5.0  # after which a rotation that the map does not confirm is given up ...
PAUSE_S = 60.0  # ... and none is looked for


class KnockDetector:
    """One `seen` per image with a pose."""

    def __init__(self) -> None:
        self.turn: F64 = np.zeros(3)  # rad about the right camera's axes, since the rig was corrected last
        # rad, mean over the last images: what the rig is wrong by, without a knock; None before the first
        self._usual: F64 | None = None
        self._since_ns = 0
        self._until_ns = 0  # no rotation is looked for before

    @staticmethod
    def wanted(config: Config, rig: Rig) -> KnockDetector | None:
        """That of a run; None where the mapper does not correct the rig."""
        corrects = config.self_calibration.mode == "auto" and config.mapper.enabled
        return KnockDetector() if corrects and rig.second_camera is not None else None

    def seen(self, tracks: Tracks, solution: PoseSolution, cameras: StereoCameras, seconds: float) -> F64 | None:
        """(3,) by which the right camera has turned; None: it has not.

        Args:
            tracks: with the pixels of the image. solution: its pose. seconds: since the image before.
        """
        known = ~tracks.moving & (tracks.age * seconds >= STATIC_S) & np.isfinite(tracks.uv_right[:, 0])
        agree = known & solution.inlier
        divided = np.count_nonzero(agree) < UNDIVIDED * np.count_nonzero(known)
        used = known if divided else agree
        enough = max(MIN_POINTS, MIN_AGREEING * np.count_nonzero(used))
        turn, usual, scale = np.zeros(3), np.zeros(3), FIRST_SCALE_PX
        for step in range(STEPS):
            count, squares, left = _turn(
                solution.pose, used, tracks.origin, tracks.direction, tracks.rho, tracks.uv, tracks.uv_right,
                cameras.cams, cameras.right_T_left, scale, turn,
            )  # fmt: skip
            if step == 0 and count >= enough:
                usual = turn.copy() if self._usual is None else self._usual
                self._usual = usual + (1.0 - math.exp(-seconds / SETTLED_S)) * (turn - usual)
            wrong = squares - left < max(MIN_SHARE * squares, MIN_SHIFT_PX**2 * count)
            if count < enough or (wrong and (not divided or step == STEPS - 1)):
                return None
            scale, enough = SCALE * math.sqrt(left / count), MIN_AGREEING * count
        return turn if np.linalg.norm(turn - usual) > SUDDEN * np.linalg.norm(turn) else None

    def watches(self, stamp_ns: int) -> bool:
        """Whether a rotation is looked for in the image of a time."""
        return stamp_ns >= self._until_ns

    def add(self, turn: F64, stamp_ns: int) -> None:
        """The right camera has turned."""
        self.turn, self._since_ns = self.turn + turn, stamp_ns
        self._usual = np.zeros(3)

    def confirmed(self) -> None:
        """The rig has been corrected."""
        self.turn = np.zeros(3)

    def given_up(self, stamp_ns: int) -> bool:
        """Whether the map has not confirmed a rotation for so long that there was none."""
        if not self.turn.any() or stamp_ns - self._since_ns < UNCONFIRMED_S * 1e9:
            return False
        self.turn, self._until_ns = np.zeros(3), stamp_ns + int(PAUSE_S * 1e9)
        return True


@njit
def _turn(pose, known, origin, direction, rho, uv_l, uv_r, cams, right_T_left, scale, turn):
    """One step of iteratively re-weighted least squares for the rotation of the right camera.

    Args:
        pose: (4, 4) odom_T_cam. known: (N,) the points used. scale: px, of the Cauchy weight of a residual at `turn`.
        turn: (3,) rad, overwritten.

    Returns:
        The sum of the weights, and the weighted sums of the squared residuals without and with the rotation, px^2.
    """
    model_l, params_l, model_r, params_r = cams
    normal, rhs, factor, jac = np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3)), np.zeros((2, 3))
    p, q, res = np.zeros(3), np.zeros(3), np.zeros(2)
    count, squares = 0.0, 0.0
    for k in range(len(rho)):
        if not known[k] or math.isnan(uv_r[k, 0]):
            continue
        for i in range(3):
            p[i] = 0.0
            for j in range(3):
                p[i] += pose[j, i] * (origin[k, j] + direction[k, j] / rho[k] - pose[j, 3])
        for i in range(3):
            q[i] = right_T_left[i, 3]
            for j in range(3):
                q[i] += right_T_left[i, j] * p[j]
        a = project_one(model_l, params_l, p[0], p[1], p[2])
        b = project_one(model_r, params_r, q[0], q[1], q[2])
        if math.isnan(a[0]) or math.isnan(b[0]):
            continue
        off = 0.0
        for i in range(2):
            res[i] = (uv_r[k, i] - b[i]) - (uv_l[k, i] - a[i])
            j0, j1, j2 = b[2 + 3 * i], b[3 + 3 * i], b[4 + 3 * i]
            jac[i, 0] = j1 * q[2] - j2 * q[1]
            jac[i, 1] = j2 * q[0] - j0 * q[2]
            jac[i, 2] = j0 * q[1] - j1 * q[0]
            e = res[i] - jac[i, 0] * turn[0] - jac[i, 1] * turn[1] - jac[i, 2] * turn[2]
            off += e * e
        w = 1.0 / (1.0 + off / (scale * scale))
        count += w
        for i in range(2):
            squares += w * res[i] * res[i]
            for j in range(3):
                rhs[j] += w * jac[i, j] * res[i]
                for m in range(3):
                    normal[j, m] += w * jac[i, j] * jac[i, m]
    if not solve_symmetric(normal, rhs, turn, factor):
        return 0.0, 0.0, 0.0
    explained = 0.0
    for j in range(3):
        explained += rhs[j] * turn[j]
    return count, squares, squares - explained
