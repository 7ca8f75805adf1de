"""Feed the system from a loop of one's own: each image is passed to `step`, which returns the frame with its pose.

    python examples/own_loop.py [FRAMES]

The images are the bundled recording's here; yours come from a camera or a disk, as arrays.
"""

import sys

import stereo_sfm as s  # before numpy: it chooses the machine code, so that the bits are those of a run

# isort: split
import numpy as np


def main(frames: int = 40) -> None:
    """Print a pose, its standard deviation and the state for every tenth image, and the path at the end."""
    with s.open_source(s.demo_recording()) as source, s.System(source.rig) as system:
        system.on(s.MapUpdate, lambda update: print(f"  the map answers keyframe {update.kf_id}"))
        for number, image in zip(range(frames), source, strict=False):
            frame = system.step(image.left, image.right, image.stamp_ns)
            if number % 10 == 0:
                x, y, z = frame.odom_T_cam[:3, 3]
                sigma_mm = 1e3 * np.sqrt(np.trace(frame.covariance[:3, :3]))
                print(f"{frame.state.name} at ({x:.3f}, {y:.3f}, {z:.3f}) m, sigma {sigma_mm:.1f} mm")
        system.finish()
        print(f"{len(system.map.points)} points, {len(system.map.kf_ids)} keyframes")
        print(f"path of {system.trajectory().length:.2f} m over {len(system.trajectory())} frames")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
