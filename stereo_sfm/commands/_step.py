"""`replay --step`: stop at every frame from a given time on and describe it."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stereo_sfm.types import Frame


class Stepper:
    """Waits for the user at every frame."""

    def __init__(self, seek_s: float = 0.0) -> None:
        """Args: seek_s, seconds after the first frame until which it does not stop."""
        self._seek_s = seek_s
        self._first_ns: int | None = None

    def go_on(self, frame: Frame) -> bool:
        """Show a frame and wait for Enter; False when the user quits (q, or the end of the input)."""
        self._first_ns = frame.stamp_ns if self._first_ns is None else self._first_ns
        seconds = (frame.stamp_ns - self._first_ns) * 1e-9
        if seconds < self._seek_s:
            return True
        print(describe(frame, seconds), flush=True)
        try:
            return input("Enter: next frame, q: stop ").strip().lower() != "q"
        except EOFError:
            print()
            return False


def describe(frame: Frame, seconds: float) -> str:
    """One line: number, time, state, points, position in the odometry frame, reference keyframe."""
    inliers, points = int(frame.observations.inlier.sum()), len(frame.observations.inlier)
    x, y, z = frame.odom_T_cam[:3, 3].tolist()
    why = f" ({frame.reason})" if frame.reason else ""
    return (
        f"frame {frame.frame_id} at {seconds:.3f} s: {frame.state.name}{why}, {inliers} of {points} points, "
        f"position {x:.4f} {y:.4f} {z:.4f} m, keyframe {frame.reference_kf_id}"
    )
