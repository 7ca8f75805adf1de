"""Make a map, save it, load it again and ask where an image was taken.

python examples/where_is_this.py [FRAMES]
"""

import sys
import tempfile

import numpy as np

import stereo_sfm as s


def main(frames: int = 60) -> None:
    """Map the first images of the bundled recording, then ask for one of them without a guess."""
    place = tempfile.mkdtemp()
    with s.open_source(s.demo_recording()) as source:
        images = [image for _, image in zip(range(frames), source, strict=False)]
        rig = source.rig
    with s.System(rig) as system:
        for image in images:
            system.step(image.left, image.right, image.stamp_ns)
    system.save_map(place)
    print(f"map: {place}")

    asked = images[len(images) // 2]
    answer = s.MapLocator(place).locate(asked.left, asked.right)
    if not answer.found:
        print(f"not found: {answer.reason}")
        return
    known = system.trajectory()
    there = known.poses[list(known.stamp_ns).index(asked.stamp_ns)]
    off_mm = 1e3 * np.linalg.norm(answer.map_T_cam[:3, 3] - there[:3, 3])
    print(f"found at {answer.map_T_cam[:3, 3].round(3)} m by {answer.inliers} corners, {off_mm:.1f} mm from its pose")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
