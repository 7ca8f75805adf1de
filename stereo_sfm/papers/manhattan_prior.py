"""Manhattan directions as a drift-free rotation prior around any tracker, switched on by evidence.

A Kalman filter on the camera's rotation: the tracker's motion predicts, its drift adds variance; the compass measures
against the world's axes, which the first consistent measurements define. A measurement that contradicts the prediction
is refused, and the correction starts only after enough of them agreed, so that a scene without three directions leaves
the tracker as it is. The corrected rotation carries the translation with it: heading errors no longer bend the path.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import ManhattanConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.lines import LineDetector
from stereo_sfm.geometry.procrustes import rotation_between
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.geometry.vanishing import Manhattan, estimate, nearest_turn
from stereo_sfm.tracking.protocol import AnyTracker
from stereo_sfm.types import F64, Frame, Keyframe, MapUpdate, StereoImage, TrackState

SETTLED = 10  # measurements that must agree before the axes are accepted


class RotationFilter:
    """Rotation of the camera in the odometry frame, from predicted motions and measured axes."""

    def __init__(self, config: ManhattanConfig) -> None:
        self._config = config
        self._drift = np.radians(config.drift_sigma_deg_per_frame) ** 2
        self._gate = np.radians(config.gate_deg)
        self._seen: list[F64] = []  # odom_R_axes of the measurements that are to define the axes
        self._odom_R_axes: F64 | None = None
        self._variance = 0.0  # rad^2 of the rotation against the axes
        self.refused = 0

    @property
    def active(self) -> bool:
        """Whether the axes are known and measurements correct."""
        return self._odom_R_axes is not None

    def predict(self) -> None:
        """One more frame of the tracker's drift."""
        self._variance += self._drift

    def expected(self, odom_R_cam: F64) -> F64 | None:
        """cam_R_axes as they should be seen, None before the first measurement."""
        axes = self._odom_R_axes if self._odom_R_axes is not None else (self._seen[-1] if self._seen else None)
        return None if axes is None else odom_R_cam.T @ axes

    def correct(self, odom_R_cam: F64, found: Manhattan) -> F64:
        """The rotation after a measurement; unchanged while the axes are not known or when it is refused."""
        seen = odom_R_cam @ found.cam_R_axes
        if self._odom_R_axes is None:
            self._settle(seen)
            return odom_R_cam
        error = se3.so3_log(self._odom_R_axes @ nearest_turn(seen, self._odom_R_axes).T)
        noise = found.sigma**2 + np.radians(self._config.model_sigma_deg) ** 2
        if np.linalg.norm(error) > min(self._gate, 4 * np.sqrt(self._variance + noise) + 1e-9):
            self.refused += 1
            return odom_R_cam
        gain = self._variance / (self._variance + noise)
        self._variance *= 1 - gain
        return se3.so3_exp(gain * error) @ odom_R_cam

    def _settle(self, seen: F64) -> None:
        """Define the axes by the mean of the first measurements that agree; start over where they do not."""
        if self._seen:
            seen = nearest_turn(seen, self._seen[0])
            if np.linalg.norm(se3.so3_log(self._seen[0].T @ seen)) > self._gate:
                self._seen = []
        self._seen.append(seen)
        if len(self._seen) < SETTLED:
            return
        columns = np.concatenate([axes.T for axes in self._seen])
        self._odom_R_axes = rotation_between(np.tile(np.eye(3), (len(self._seen), 1)), columns)
        self._variance = np.radians(self._config.model_sigma_deg) ** 2 / len(self._seen)


class ManhattanTracker:
    """A tracker whose odometry is corrected by the compass."""

    def __init__(self, inner: AnyTracker, config: ManhattanConfig, rig: Rig) -> None:
        self._inner = inner
        self._config = config
        self._lines = LineDetector(rig.left)
        self._filter = RotationFilter(config)
        self._outer_T_inner = np.eye(4)  # corrected odometry frame from the tracker's, now and at the last keyframe
        self._outer_T_inner_kf = np.eye(4)

    def apply(self, update: MapUpdate) -> None:
        """The map lives in the corrected odometry frame; the tracker gets it in its own."""
        self._inner.apply(replace(update, map_T_odom=update.map_T_odom @ self._outer_T_inner))

    def describe(self, keyframe: Keyframe) -> Keyframe:
        """The keyframe of the last step with its descriptors."""
        return self._inner.describe(keyframe)

    def step(self, image: StereoImage) -> tuple[Frame, Keyframe | None]:
        """Track one image and correct its rotation."""
        frame, keyframe = self._inner.step(image)
        pose = self._outer_T_inner @ frame.odom_T_cam
        self._filter.predict()
        stats = dict(frame.stats)
        good = frame.state in (TrackState.OK, TrackState.RECOVERED)
        if good and image.frame_id % self._config.every == 0:
            try:
                expected, rng = self._filter.expected(pose[:3, :3]), np.random.default_rng(image.frame_id)
                found = estimate(self._lines.detect(image.left), rng, expected=expected)
                turned = self._filter.correct(pose[:3, :3], found)
                pose = se3.orthonormalize(se3.from_rotation_translation(turned, pose[:3, 3]))
                self._outer_T_inner = se3.orthonormalize(pose @ se3.inverse(frame.odom_T_cam))
                stats["line_share"] = found.share
            except Degenerate:
                stats["line_share"] = 0.0
        if keyframe is not None:  # of this image, or of an earlier one that a monocular start began with
            self._outer_T_inner_kf = self._outer_T_inner
            keyframe = replace(keyframe, odom_T_cam=self._outer_T_inner @ keyframe.odom_T_cam)
        inner_T_kf = frame.odom_T_cam @ se3.inverse(frame.kf_T_cam)  # where the tracker has it now
        kf_T_cam = se3.inverse(self._outer_T_inner_kf @ inner_T_kf) @ pose
        return replace(frame, odom_T_cam=pose, kf_T_cam=kf_T_cam, stats=stats), keyframe
