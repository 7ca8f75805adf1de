"""The systems of the three papers as configurations: name -> what differs from the defaults."""

from __future__ import annotations

from typing import Any

from stereo_sfm.errors import StereoSfmError, did_you_mean

PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    # Retail Store Visual Structure-from-Motion: SIFT in the mask of stereo-matched points, brute force with Lowe's
    # ratio and fundamental RANSAC, EM-R, keyframes at < 30 % or 30 frames, co-visible window, loops at 30 % matches.
    # The bound of equation 11 stays as wide as the stereo depth is uncertain: fixed, far points would never agree.
    "retail-thesis": {
        "features": {"kind": "sift", "mask_radius_px": 40.0, "stereo_check": "ransac"},
        "odometry": {"method": "em-r", "refine": False, "weighted": False},
        "mapper": {"association": "previous", "window_keyframes": 0, "fixed_keyframes": 0, "redundant_share": 2.0},
        "loop": {
            "reference": "best",
            "robust": "none",
            "consistent": 1,
            "min_match_fraction": 0.3,
            "proximity": False,
        },
    },
    # Sparse Visual Localization in GPS-Denied Indoor Environments: 2,000 ORB points, RANSAC over eight points, the
    # essential matrix decomposed, motions accumulated. No map. Scale from depth where the source has any.
    "sparse-localization": {
        "features": {"kind": "orb", "count": 2000, "stereo_only": False},
        "odometry": {"method": "eight-point"},
        "mapper": {"enabled": False},
        "loop": {"enabled": False},
    },
    # Visual SLAM of the C++ course: one camera, ORB, essential matrix at the start, PnP against the last keyframe and
    # motion-only bundle adjustment, keyframes after more than 19 frames with fewer than 80 inliers; below 60 at once,
    # or tracking would end before the 19 frames do.
    "cpp-course": {
        "features": {"kind": "orb", "count": 2000, "stereo_only": False},
        "odometry": {
            "method": "pnp",
            "monocular": True,
            "reference": "keyframe",
            "keyframe_ratio": 0.0,
            "keyframe_frames": 0,
            "keyframe_min_frames": 19,
            "keyframe_min_inliers": 80,
        },
        "loop": {"enabled": False},
    },
}


def preset(name: str) -> dict[str, Any]:
    """Nested overrides for `config.load`.

    Raises:
        StereoSfmError: unknown name.
    """
    if name not in PRESETS:
        raise StereoSfmError(
            f"unknown preset '{name}'{did_you_mean(name, PRESETS)}: choose one of {', '.join(PRESETS)}"
        )
    return PRESETS[name]
