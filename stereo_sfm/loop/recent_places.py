"""Where is a camera that saw nothing for a while? Its newest keyframes tell, by the descriptors of their corners."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import LoopConfig
from stereo_sfm.geometry import se3
from stereo_sfm.loop.absolute_pose import ransac_pose, refine_pose
from stereo_sfm.loop.cloud import Cloud, gather, match_guided
from stereo_sfm.loop.place_view import PlaceView, place_view_of
from stereo_sfm.loop.verification import pair
from stereo_sfm.types import F64, Keyframe

REMEMBERED = 12  # newest keyframes
ASKED = 2  # of them, those that should look most alike
AROUND = 2  # keyframes whose points are added to those of the one that is asked
WINDOWS = 0.05, 0.12, 0.3  # shares of the image's width
PIXEL_SIGMA = 2.0  # px, of a corner found again from so far away
LEAST, AGREEING = 12, 0.5  # corners that must agree, and as a share of those that were matched
METRES_A_RADIAN = 2.0  # a view differs as much after so many metres as after a turn by one radian


class RecentPlaces:
    """Finds the camera of a keyframe among the newest keyframes of the same odometry (tracking.protocol.Places)."""

    def __init__(self, config: LoopConfig, rig: Rig) -> None:
        self._config, self._rig = config, rig
        self._keyframes: deque[Keyframe] = deque(maxlen=REMEMBERED)

    def add(self, keyframe: Keyframe) -> None:
        """Remember the newest; another submap begins anew."""
        if self._keyframes and self._keyframes[-1].submap_id != keyframe.submap_id:
            self._keyframes.clear()
        self._keyframes.append(keyframe)

    def find(self, seen: Keyframe, expected: F64) -> Iterator[F64]:
        """Poses odom_T_cam (4, 4) from which the camera may see what it sees: most likely first, none of them certain.

        Args:
            seen: what the camera sees; its pose is not used. expected: (4, 4) odom_T_cam. Corners are first looked for
                near where they would be from there, then further and further away.
        """
        view = place_view_of(seen, self._rig, self._config.disparity_sigma_px)
        clouds = [(k, self._around(k)) for k in self._order(expected)[:ASKED]]
        for share in WINDOWS:
            for centre, cloud in clouds:
                rng = np.random.default_rng([self._config.seed, seen.frame_id, centre.kf_id])
                b_T_a = self._match(se3.inverse(expected) @ centre.odom_T_cam, view, cloud, share, rng)
                if b_T_a is not None:
                    yield se3.orthonormalize(centre.odom_T_cam @ se3.inverse(b_T_a))

    def _around(self, centre: Keyframe) -> Cloud:
        others = sorted(self._keyframes, key=lambda k: (abs(k.kf_id - centre.kf_id), k.kf_id))[1 : 1 + AROUND]
        return gather(centre, others, self._rig, self._config.disparity_sigma_px)

    def _match(self, b_T_a: F64, view: PlaceView, cloud: Cloud, share: float, rng: np.random.Generator) -> F64 | None:
        """A better b_T_a by corners within a share of the image's width of where they are expected."""
        config, rig = self._config, self._rig
        window = share * rig.left.width
        rows_b, rows_a = match_guided(b_T_a, view, cloud, rig, config.max_distance_bits, window)
        corner = view.corner[rows_b]
        matches = pair(view, cloud, rows_b[corner], rows_a[corner])
        start = ransac_pose(matches, rig, rng, PIXEL_SIGMA, config.ransac_iterations)
        if start is None:
            return None
        pose = refine_pose(start, matches, rig, PIXEL_SIGMA)
        enough = pose.inlier.sum() >= max(LEAST, AGREEING * len(matches))
        return pose.b_T_a if enough else None

    def _order(self, expected: F64) -> list[Keyframe]:
        def differs(keyframe: Keyframe) -> tuple[float, int]:
            metres, radians = se3.extent(se3.inverse(keyframe.odom_T_cam) @ expected)
            return float(metres + METRES_A_RADIAN * radians), -keyframe.kf_id

        return sorted(self._keyframes, key=differs)
