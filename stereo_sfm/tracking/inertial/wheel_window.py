"""How the way by the wheels differs from the way by the images, over the last seconds.

Unknown are the wheels' scale, the direction in which they drive as seen from the camera, and the scale of their turns:
small numbers that calibrations get wrong and that tyres change. The rest is noise, whose size is found with them.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.types import F64

LINKS = 20  # half seconds
DIRECTION_SIGMA = 0.03  # rad, expected of a calibration
TURN_SIGMA = {"skid_steer": 0.3}  # expected of the scale of turns, where that is not the slip
STRAIGHT = 0.05  # rad/s of a robot that does not turn
TURN_FREE = 0.03, 0.1  # rad and share by which turns differ without slip
MIN_SIGMA = 0.003  # m, rad: standard deviation of a link's difference, at least
SHOWN, JUDGED = 2, 6  # links for the comparison with the images: before they count, and before they are left out
WRONG, RIGHT = 0.5, 0.25  # of the way: more is another motion, less is the same again
NOTICED = 0.1  # m of way, rad of turns, before anything is judged


@dataclass(frozen=True, eq=False)
class WheelCorrection:
    """Corrections of the wheels' velocities: `matrix @ linear`, `turn * angular`."""

    matrix: F64  # (3, 3)
    turn: float
    covariance: F64  # (4, 4) of logarithmic scale and direction (3,)
    turn_sigma: float
    noise: float  # m/sqrt(s) of a position
    turn_noise: float  # rad/sqrt(s)
    heading_sigma: float  # rad, of the direction at one image: how far the camera sways


@dataclass(frozen=True, eq=False)
class _Link:
    """About half a second by the uncorrected wheels and by the images, in wheel axes."""

    seconds: float
    way: F64  # (3,) m by the wheels
    seen: F64  # (3,) m by the images
    turn: float  # rad by the wheels
    turn_seen: float


class WheelWindow:
    """Motions by the wheels and by the images, oldest first."""

    def __init__(self, model: str, slip: float) -> None:
        """`slip`: standard deviation of the scale, expected of a calibration of wheels of a model."""
        self._slip, self._turn_sigma = slip, TURN_SIGMA.get(model, slip)
        self._rigid = model != "skid_steer"
        self._links: deque[_Link] = deque(maxlen=LINKS)
        self.left_out = False  # they contradict the images
        self.agreed = False  # they have agreed with the images since

    @property
    def silent(self) -> bool:
        """Whether they have measured nothing at all of late."""
        return not any(k.way.any() or k.turn for k in list(self._links)[1 - JUDGED :])

    def begin(self) -> None:
        """What was before does not go with what comes."""
        self._links.clear()

    def add(self, seconds: float, by_wheels: F64, seen: F64) -> None:
        """A motion (4, 4) by the uncorrected wheels and by the images, in wheel axes."""
        turn, turn_seen = (float(se3.so3_log(m[:3, :3])[2]) for m in (by_wheels, seen))
        self._links.append(_Link(seconds, by_wheels[:3, 3], seen[:3, 3], turn, turn_seen))
        self._judge()

    def _judge(self) -> None:
        recent = list(self._links)[-JUDGED:]
        ways = [(np.sum((k.way - k.seen) ** 2), max(k.way @ k.way, k.seen @ k.seen)) for k in recent]
        turns = [((k.turn - k.turn_seen) ** 2, max(k.turn**2, k.turn_seen**2)) for k in recent]
        judged = [float(off / size) for off, size in (np.sum(ways, 0), np.sum(turns, 0)) if size > NOTICED**2]
        if not judged:
            return
        if len(recent) == JUDGED:
            self.left_out = max(judged) > (RIGHT if self.left_out else WRONG) ** 2
        if len(recent) >= SHOWN and max(judged) <= RIGHT**2:
            self.agreed = True
        self.agreed &= not self.left_out

    def correction(self) -> WheelCorrection:
        """What the window says; what is expected of a calibration while it is short."""
        x, covariance, sigma2 = self._direction()
        turn, turn_sigma, turn_sigma2 = self._turn()
        way2 = float(np.mean([k.way @ k.way for k in self._links])) if self._links else 0.0
        seconds = float(np.mean([k.seconds for k in self._links])) if self._links else 0.5
        return WheelCorrection(
            matrix=np.exp(x[0]) * se3.so3_exp(x[1:]),
            turn=turn,
            covariance=covariance,
            turn_sigma=turn_sigma,
            noise=float(np.sqrt(sigma2 / seconds)),
            turn_noise=float(np.sqrt(turn_sigma2 / seconds)),
            heading_sigma=min(float(np.sqrt(sigma2 / max(way2, 1e-6))), DIRECTION_SIGMA),
        )

    def _direction(self) -> tuple[F64, F64, float]:
        """Logarithmic scale and direction (4,), their covariance, and the variance of what is left of a link's way."""
        prior: F64 = np.diag(1.0 / np.square([self._slip, DIRECTION_SIGMA, DIRECTION_SIGMA, DIRECTION_SIGMA]))
        x, information, sigma2 = np.zeros(4), prior, MIN_SIGMA**2
        if not self._links:
            return x, np.linalg.inv(information).astype(np.float64), sigma2
        way, seen = np.stack([k.way for k in self._links]), np.stack([k.seen for k in self._links])
        jacobian, error = np.concatenate([way[:, :, None], -se3.skew(way)], axis=2), seen - way
        share = np.array([self.doubt(k.seconds, k.turn, k.turn_seen) for k in self._links])
        slip2, usual = (way**2).sum(axis=1) * share**2, share <= self._slip
        for _ in range(2):  # the second time with the size of the noise
            weighted = jacobian / (sigma2 + slip2)[:, None, None]
            information = prior + np.einsum("nij,nik->jk", weighted, jacobian)
            x = np.linalg.solve(information, np.einsum("nij,ni->j", weighted, error))
            left = (error - jacobian @ x)[usual]
            sigma2 = max(float(np.mean(left**2)) if len(left) else 0.0, MIN_SIGMA**2)
        return x.astype(np.float64), np.linalg.inv(information).astype(np.float64), sigma2

    def doubt(self, seconds: float, by_wheels: float, turned: float) -> float:
        """The share of the way that is in doubt: what is expected of a calibration while the robot turns, more where
        wheels slip: they turn (rad, in about half a second) otherwise than others say. Skid-steer slips in all turns.
        """
        if abs(turned) < STRAIGHT * seconds:
            return 0.0
        off = abs(by_wheels - turned)
        if not (self._rigid and off > TURN_FREE[0] + TURN_FREE[1] * abs(turned)):
            return self._slip
        return max(self._slip, min(off / max(abs(by_wheels), TURN_FREE[0]), 1.0))

    def _turn(self) -> tuple[float, float, float]:
        """Scale of turns, its standard deviation, and the variance of what is left of a link's turn."""
        w, v = (np.array([getattr(k, name) for k in self._links], float) for name in ("turn", "turn_seen"))
        scale, information, sigma2 = 1.0, 1.0 / self._turn_sigma**2, MIN_SIGMA**2
        for _ in range(2):
            information = 1.0 / self._turn_sigma**2 + float(w @ w) / sigma2
            scale = 1.0 + float(w @ (v - w)) / sigma2 / information
            sigma2 = max(float(np.mean(np.square(v - scale * w))) if len(w) else 0.0, MIN_SIGMA**2)
        return scale, float(information**-0.5), sigma2
