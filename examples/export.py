"""Export the map and the trajectory for other programs: COLMAP, a point cloud, TUM.

python examples/export.py [FRAMES]
"""

import sys
import tempfile
from pathlib import Path

import stereo_sfm as s


def main(frames: int = 40) -> None:
    """Run on part of the bundled recording and write what became of it."""
    place = Path(tempfile.mkdtemp())
    with s.open_source(s.demo_recording()) as source, s.System(source.rig) as system:
        for _, image in zip(range(frames), source, strict=False):
            system.step(image.left, image.right, image.stamp_ns)
        system.finish()
        s.export_map(system.saved_map(), place / "colmap", "colmap")
        s.export_map(system.saved_map(), place / "points.ply", "ply")
        s.export_trajectory(system.trajectory(), place / "trajectory.tum", "tum")
    print("written:", ", ".join(str(path) for path in sorted(place.iterdir())))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
