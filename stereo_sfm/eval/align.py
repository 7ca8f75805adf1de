"""Alignment of an estimate to a reference before the two are compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereo_sfm.errors import StereoSfmError, one_of
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, Trajectory

MODES = ("se3", "sim3", "origin", "none")


@dataclass(frozen=True)
class Alignment:
    """reference_T_estimate and scale: p_reference = R (scale p_estimate) + t."""

    transform: F64  # (4, 4)
    scale: float

    def apply(self, trajectory: Trajectory) -> Trajectory:
        """The trajectory in the reference's frame and scale."""
        poses = trajectory.poses.copy()
        poses[:, :3, 3] *= self.scale
        return Trajectory(trajectory.stamp_ns.copy(), self.transform @ poses, trajectory.oriented)


def align(estimate: Trajectory, reference: Trajectory, mode: str = "se3") -> Alignment:
    """The alignment of two trajectories of equal stamps.

    Args:
        estimate: (N,) poses. reference: (N,) poses.
        mode: `se3` and `sim3` least squares over the positions (Umeyama 1991); `origin` aligns the first poses with
            each other; `none`: no alignment.

    Raises:
        StereoSfmError: too few poses, or a path that does not determine the alignment.
    """
    if mode == "none":
        return Alignment(np.eye(4), 1.0)
    if mode == "origin" and not (estimate.oriented and reference.oriented):
        raise StereoSfmError("positions without orientations have no first pose to align: try --align se3")
    if mode == "origin":
        return Alignment(reference.poses[0] @ se3.inverse(estimate.poses[0]), 1.0)
    one_of(mode, MODES, "alignment")
    try:
        transform, scale = se3.umeyama(estimate.positions, reference.positions, with_scale=mode == "sim3")
    except ValueError as error:
        raise StereoSfmError(f"cannot align {len(estimate)} poses: {error} (try --align origin)") from None
    return Alignment(transform, scale)
