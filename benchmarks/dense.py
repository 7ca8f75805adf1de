"""Dense depth, surfaces and obstacles: every sentence that must hold, with the figure that says whether it does.

    python benchmarks/dense.py --keep DIR                 goes on with the next part after a break
    python benchmarks/dense.py --parts pairs --pairs 4    a look
    python benchmarks/dense.py --parts fisheye --metres 4 --rays 1

Parts need data that is not part of the project, and are left out without it:

* `--middlebury DIR`: motorcycle_left.png, motorcycle_right.png, motorcycle_disp.npz (scikit-image 0.17.2);
* `--aloe DIR`: aloeL.jpg, aloeR.jpg, aloeGT.png (Debian's opencv-doc). Its ground truth is in whole pixels, which
  rewards disparities drawn to whole pixels: exact ones have a median error of 0.25 px;
* STEREO_SFM_DATA: store_pairs (rendered fisheye pairs with exact ranges), and real drives.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from contextlib import nullcontext
from pathlib import Path

from _sequences import one_thread

one_thread()

from _dense_drives import real, simulated
from _dense_pairs import PAIRS, aloe, latencies, live, motorcycle, sgbm, store_pairs
from _verdicts import Verdicts

REAL = {"euroc_mh01": "euroc_mh01", "kitti": "kitti", "library_walk": "library_walk", "store_walk": "store_walk"}
TESTS = {
    "the same bits inline, in processes and again": ["tests/dense/test_build.py", "tests/pipeline/test_live_depth.py"],
    "a costmap by the rules of map_server": ["tests/dense/test_costmap.py"],
    "/obstacles received by a node of ROS 2": ["tests/service/test_ros2.py::test_nodes_receive_depth_and_obstacles"],
    "pycolmap fuses the COLMAP export": ["tests/dense/test_colmap.py"],
}
PARTS = ("motorcycle", "aloe", "pairs", "fisheye", "pinhole", *REAL, "live", "tests")


def _tests(verdicts: Verdicts) -> None:
    """What tests show; a test that was left out shows nothing."""
    for sentence, files in TESTS.items():
        command = [sys.executable, "-m", "pytest", "-n", "0", *files]
        done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True)
        last = (done.stdout.strip().splitlines() or ["no output"])[-1].strip("= ")
        verdicts.row(sentence, done.returncode == 0 and "skipped" not in last, last.partition(" in ")[0])


def main() -> None:
    """Every part whose data is at hand."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--middlebury", type=Path)
    parser.add_argument("--aloe", type=Path)
    parser.add_argument("--pairs", type=int, default=PAIRS, help="of store_pairs, evenly spread (default: all 24)")
    parser.add_argument("--metres", type=float, default=40.0, help="of a rendered drive")
    parser.add_argument("--rays", type=int, default=4, help="squared, a pixel of a rendered drive")
    parser.add_argument("--open3d", type=Path, metavar="PYTHON", help="an interpreter that has it, for comparison")
    parser.add_argument("--keyframes", type=int, default=40, help="of a real drive")
    parser.add_argument("--keep", type=Path, help="folder of runs, and of the rows of parts that ended")
    parser.add_argument("--write", action="store_true", help="replace the benchmark's figures")
    options = parser.parse_args()
    data = Path(os.environ.get("STEREO_SFM_DATA", "../shared/data"))
    needed = {"motorcycle": options.middlebury, "aloe": options.aloe, "pairs": data / "store_pairs"}
    needed |= {"live": data / "store_pairs"} | {name: data / place for name, place in REAL.items()}
    with tempfile.TemporaryDirectory() if options.keep is None else nullcontext(str(options.keep)) as name:
        folder = Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        verdicts = Verdicts(folder / "rows.json")
        print("| what must hold | measured | |\n|---|---|---|")
        for part in options.parts:
            place = needed.get(part, folder)
            if place is None or not place.is_dir() or not verdicts.begins(part):
                continue
            if part == "motorcycle":
                motorcycle(verdicts, place)
            elif part == "aloe":
                aloe(verdicts, place)
            elif part == "pairs":
                store_pairs(verdicts, place, options.pairs)
            elif part == "live":
                live(verdicts, place, options.pairs)
                latencies(verdicts)
            elif part == "tests":
                _tests(verdicts)
            elif part in REAL:
                real(verdicts, folder, part, str(place), options.keyframes, sgbm)
            else:
                simulated(verdicts, folder, part, options.metres, options.rays, options.open3d)
            verdicts.keep()
        if options.write:
            print(verdicts.write(PARTS, "dense", "Depth, surfaces, obstacles"), file=sys.stderr)
    sys.exit(verdicts.failed)


if __name__ == "__main__":
    main()
