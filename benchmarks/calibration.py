"""Accuracy of the calibration with targets: rendered boards with ground truth, and real images compared with OpenCV.

python benchmarks/calibration.py --rendered            five seeds, fisheye and pinhole, noise and blur
python benchmarks/calibration.py --real DATA_FOLDER    reprojection error compared with cv2.stereoCalibrate
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.solve import Calibration, align_pairs, calibrate
from stereo_sfm.calib.targets import Detection, Target
from stereo_sfm.calib.views import find_pairs, read_pairs
from stereo_sfm.drivers.sim.boards import Faults, render_boards
from stereo_sfm.drivers.sim.rigs import make_rig
from stereo_sfm.types import F64

BOARD = Target("charuco", 8, 8, 0.06, 0.75, "DICT_5X5_100")
RENDERED = {"fisheye": ("kb4", 110.0), "distorted": ("pinhole", 45.0)}
REAL = {
    "calib_chessboard_pinhole": (Target("checkerboard", 9, 6, 0.025), "pinhole"),
    "calib_chessboard_fisheye": (Target("checkerboard", 9, 6, 0.02423), "kb4"),
    "calib_aprilgrid_euroc": (Target("aprilgrid", 6, 6, 0.088, 0.3), "pinhole"),
}


def errors(found: Rig, true: Rig) -> tuple[float, float, float]:
    """Worst focal error in %, worst centre in px, baseline in %."""
    assert found.right is not None and true.right is not None
    pairs = ((found.left, true.left), (found.right, true.right))
    focal = max(abs(100 * (getattr(a, n) / getattr(b, n) - 1)) for a, b in pairs for n in ("fx", "fy"))
    centre = max(abs(getattr(a, n) - getattr(b, n)) for a, b in pairs for n in ("cx", "cy"))
    return focal, centre, abs(100 * (found.baseline / true.baseline - 1))


def rendered(seeds: int, views: int) -> bool:
    """Print one line a seed; whether all are within the limits."""
    good = True
    print("camera     seed  corners  rms px  focal %  centre px  baseline %  (limits 0.1, 0.3, 0.2)")
    for name, (model, field) in RENDERED.items():
        rig = make_rig(name)
        for seed in range(seeds):
            pairs, _ = render_boards(rig, BOARD, views, seed, Faults(), field)
            left, right = ([BOARD.detect(p[k]) for p in pairs] for k in range(2))
            result = calibrate(left, right, BOARD.points, rig.left.size, model)
            focal, centre, baseline = errors(result.rig, rig)
            within = focal < 0.1 and centre < 0.3 and baseline < 0.2
            good &= within
            line = f"{name:10s} {seed:4d} {len(result.observed.view):8d} {result.rms:7.3f} {focal:8.4f} {centre:10.3f}"
            print(f"{line} {baseline:11.4f}  {'ok' if within else 'OUTSIDE'}", flush=True)
    return good


def real(root: Path) -> None:
    """Reprojection error of the real images, ours and OpenCV's on the same detections."""
    print("images                    ours px  on all corners  OpenCV px  (root mean square)  ours s  OpenCV s")
    for folder, (target, model) in REAL.items():
        pairs = list(read_pairs(find_pairs(root / folder)))
        size = (pairs[0][0].shape[1], pairs[0][0].shape[0])
        left, right = ([target.detect(p[k]) for p in pairs] for k in range(2))
        right = align_pairs(left, right) if target.kind == "checkerboard" else right
        start = time.perf_counter()
        ours = calibrate(left, right, target.points, size, model)
        middle = time.perf_counter()
        theirs = opencv(left, right, target.points, size, model)
        seconds = middle - start, time.perf_counter() - middle
        everything = everywhere(ours, left, right, target.points)
        print(f"{folder:25s} {ours.rms:7.3f} {everything:15.3f} {theirs:10.3f} {seconds[0]:27.1f} {seconds[1]:9.1f}")


def everywhere(result: Calibration, left: list[Detection], right: list[Detection], points: F64) -> float:
    """Root mean square over all corners that OpenCV uses, including our outliers."""
    from stereo_sfm.geometry import se3

    assert result.rig.right is not None
    squares: list[F64] = []
    for v, (a, b) in enumerate(zip(left, right, strict=True)):
        pose = result.left_T_target[v]
        common, i, j = np.intersect1d(a.ids, b.ids, return_indices=True)
        if len(common) < 8 or not np.isfinite(pose).all():
            continue
        p = se3.transform(pose, points[common])
        q = se3.transform(se3.inverse(result.rig.left_T_right), p)
        squares.append(((a.uv[i] - result.rig.left.project(p)) ** 2).sum(1))
        squares.append(((b.uv[j] - result.rig.right.project(q)) ** 2).sum(1))
    return float(np.sqrt(np.nanmean(np.concatenate(squares))))


def opencv(left: list[Detection], right: list[Detection], points: F64, size: tuple[int, int], model: str) -> float:
    """The error that cv2.stereoCalibrate or cv2.fisheye.stereoCalibrate reports; NaN when it gives up."""
    xyz: list[Any] = []
    uv: tuple[list[Any], list[Any]] = ([], [])
    for a, b in zip(left, right, strict=True):
        common, i, j = np.intersect1d(a.ids, b.ids, return_indices=True)
        if len(common) >= 8:
            xyz.append(points[common].astype(np.float32).reshape(-1, 1, 3))
            uv[0].append(a.uv[i].astype(np.float32).reshape(-1, 1, 2))
            uv[1].append(b.uv[j].astype(np.float32).reshape(-1, 1, 2))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-9)
    try:
        if model == "kb4":
            guess = np.array([[0.3 * size[0], 0, size[0] / 2], [0, 0.3 * size[0], size[1] / 2], [0, 0, 1]])
            flags = cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW
            flags |= cv2.fisheye.CALIB_USE_INTRINSIC_GUESS
            guesses: list[Any] = [guess.copy(), np.zeros((4, 1)), guess.copy(), np.zeros((4, 1))]
            return float(cv2.fisheye.stereoCalibrate(xyz, *uv, *guesses, size, flags=flags, criteria=criteria)[0])
        single = [cv2.calibrateCamera(xyz, u, size, None, None) for u in uv]  # type: ignore[call-overload]
        guesses = [m for result in single for m in result[1:3]]
        flags = cv2.CALIB_USE_INTRINSIC_GUESS
        return float(cv2.stereoCalibrate(xyz, *uv, *guesses, size, flags=flags, criteria=criteria)[0])
    except cv2.error:
        return float("nan")


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rendered", action="store_true")
    parser.add_argument("--real", type=Path, default=None, metavar="FOLDER")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--views", type=int, default=24)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    good = rendered(args.seeds, args.views) if args.rendered else True
    if args.real is not None:
        real(args.real)
    return 0 if good else 3


if __name__ == "__main__":
    raise SystemExit(main())
