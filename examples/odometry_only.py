"""Odometry without a map: `Tracker.step` gives the pose of each image as the first camera sees it.

python examples/odometry_only.py [FRAMES]
"""

import sys

import stereo_sfm as s


def main(frames: int = 30) -> None:
    """Print how far the camera has moved, from images given as floats from 0 to 1."""
    with s.open_source(s.demo_recording()) as source:
        tracker = s.Tracker(source.rig)
        for number, image in zip(range(frames), source, strict=False):
            assert image.right is not None
            frame = tracker.step(image.left / 255.0, image.right / 255.0, image.stamp_ns)
            if number % 10 == 9:
                print(f"{frame.state.name}: {frame.odom_T_cam[:3, 3].round(3)} m from the first image")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
