"""Test of `check-calib` with known faults added to good calibrations, and with the good ones. One row for each fault.

python benchmarks/check_calib.py                        all available real sequences and the simulated ones
python benchmarks/check_calib.py kitti sim:loop         these
python benchmarks/check_calib.py --faults pitch+ both-  some faults (the true rig is always checked)

Each cell has the verdict and the correction estimated by check-calib, +- its standard deviation: degrees about the axis
of the rotation, or per cent of focal length; for the true rig the rotation about x, y, z, the right focal length
relative to the left, and both, in brackets where not observable. Every cell rectifies, matches and checks anew with the
faulty rig.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import _sequences
import numpy as np

_sequences.one_thread()

from stereo_sfm.calib.check import CheckReport, check
from stereo_sfm.calib.rectification import rectify
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.tracks import MAX_FRAMES, collect, corners_for
from stereo_sfm.drivers.source import open_source
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.types import StereoImage

SOURCES = ("kitti", "euroc_mh01", "tum_vi_room1", "t265_office")
SIMULATED = tuple(f"sim:loop?frames=200&rate=15&camera={c}" for c in ("fisheye", "pinhole", "distorted"))
AXES = ("pitch", "yaw", "roll")  # about x, y, z of the camera
WINDOWS = 10
TURN_DEG, FOCAL = 0.2, 0.02


@dataclass(frozen=True)
class Fault:
    """A change of a true rig, and the number of the finding that should detect it."""

    name: str
    apply: Callable[[Rig], Rig]
    finding: str = ""
    index: int = 0


def turned(rig: Rig, side: str, axis: int, degrees: float) -> Rig:
    """One camera rotated about its own centre."""
    turn = np.zeros(6)
    turn[3 + axis] = np.deg2rad(degrees)
    if side == "right":
        return replace(rig, left_T_right=rig.left_T_right @ se3.exp(turn))
    return replace(rig, left_T_right=se3.inverse(se3.exp(turn)) @ rig.left_T_right)


def magnified(rig: Rig, left: float, right: float) -> Rig:
    """Focal lengths times factors."""
    assert rig.right is not None
    return replace(rig, left=_focal(rig.left, left), right=_focal(rig.right, right))


def _focal(camera: Camera, factor: float) -> Camera:
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def faults() -> list[Fault]:
    """The true rig, every axis of each camera and each focal length, both signs."""
    out = [Fault("true", lambda rig: rig)]
    for side, (axis, name), sign in itertools.product(("right", "left"), enumerate(AXES), (1, -1)):
        out.append(
            Fault(
                f"{side} {name} {sign * TURN_DEG:+.1f}°",
                lambda rig, e=side, a=axis, d=sign * TURN_DEG: turned(rig, e, a, d),
                "rotation between the cameras",
                axis,
            )
        )
    for name, left, right in (("right", 0, 1), ("left", 1, 0), ("both", 1, 1)):
        for sign in (1, -1):
            a, b = 1 + sign * FOCAL * left, 1 + sign * FOCAL * right
            finding = "focal length, both cameras" if left and right else "focal length, right relative to left"
            change = f"{name} focal {100 * sign * FOCAL:+.0f} %"
            out.append(Fault(change, lambda rig, a=a, b=b: magnified(rig, a, b), finding))
    return out


def judge(rig: Rig, images: list[StereoImage]) -> CheckReport:
    """As the command does for a recording of these images."""
    rectification = rectify(rig, "epipolar")
    gap = max(0, len(images) // WINDOWS - MAX_FRAMES)
    return check(rig, rectification, collect(images, rectification, WINDOWS, gap, corners_for(len(images), WINDOWS)))


def cell(report: CheckReport, fault: Fault) -> tuple[str, bool]:
    """The cell's text, and whether it is as expected (a fault may be reported as not observable)."""
    if not fault.finding:
        worst = [f.name for f in report.findings if f.level == report.level] if report.level else []
        return report.verdict + "".join(f" ({w})" for w in worst) + _all(report), report.verdict == "PASS"
    found = next(f for f in report.findings if f.name == fault.finding)
    number = f"{found.value[fault.index]:+.2f}±{found.sigma[fault.index]:.2f}"
    if not found.judged and report.verdict != "FAIL":
        return f"not judged {number}", True
    return f"{report.verdict} {number}", report.verdict == "FAIL"


def _all(report: CheckReport) -> str:
    """The findings of an unchanged rig: rotation, ratio of the focal lengths, both focal lengths."""
    names = ("rotation between the cameras", "focal length, right relative to left", "focal length, both cameras")
    parts: list[str] = []
    for f in (f for name in names for f in report.findings if f.name == name):
        numbers = ", ".join(f"{v:+.2f}±{s:.2f}" for v, s in zip(f.value, f.sigma, strict=True))
        parts.append(numbers if f.judged else f"[{numbers}]")
    return "  " + "; ".join(parts)


def main() -> int:
    """One block for each source; exit code 3 if a cell is not as expected."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*")
    parser.add_argument("--faults", nargs="*", default=[], metavar="NAME", help="only faults whose name holds one")
    parser.add_argument("--frames", type=int, default=200)
    args = parser.parse_args()
    root = _sequences.data_root()
    real = [name for name in SOURCES if root is not None and (root / name).is_dir()]
    good = True
    for name in args.sources or [*real, *SIMULATED]:
        with open_source(root / name if root is not None and name in SOURCES else name) as source:
            images, rig = list(itertools.islice(source, args.frames)), source.rig
        print(f"\n{name}: {len(images)} frames", flush=True)
        for fault in faults():
            if fault.finding and args.faults and not any(part in fault.name for part in args.faults):
                continue
            start = time.perf_counter()
            text, right = cell(judge(fault.apply(rig), images), fault)
            good &= right
            mark = "" if right else "   <-- not as it should be"
            print(f"  {fault.name:18s} {text:28s} {time.perf_counter() - start:5.1f} s{mark}", flush=True)
    return 0 if good else 3


if __name__ == "__main__":
    sys.exit(main())
