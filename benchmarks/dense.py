"""Dense depth: errors on pairs with ground truth, beside OpenCV's matcher alone.

Rows need data that is not part of the project, and are left out without it:

* `--middlebury DIR`: motorcycle_left.png, motorcycle_right.png, motorcycle_disp.npz (scikit-image 0.17.2);
* `--aloe DIR`: aloeL.jpg, aloeR.jpg, aloeGT.png (Debian's opencv-doc). Its ground truth is in whole pixels, which
  rewards disparities drawn to whole pixels: its median says little about sub-pixel errors;
* STEREO_SFM_DATA with store_pairs: rendered fisheye pairs with exact ranges.

    python benchmarks/dense.py [--middlebury DIR] [--aloe DIR] [--pairs N]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

from _sequences import one_thread

one_thread()

import cv2
import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.dense.depth import disparities, pair_depth
from stereo_sfm.dense.views import stereo_view
from stereo_sfm.geometry.cameras import KannalaBrandt
from stereo_sfm.types import F32, F64, U8, Bool

PAIRS = 24  # in store_pairs
NEAR_M = 2.5  # shelves as a robot sees them


def sgbm(left: U8, right: U8, count: int) -> F32:
    """OpenCV's matcher as its examples use it."""
    matcher = cv2.StereoSGBM.create(0, count, 5, 200, 800, 1, 0, 10, 100, 2, cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    found = np.asarray(matcher.compute(left, right)).astype(np.float32) / 16
    found[found < 0] = np.nan
    return found


def row(name: str, found: F32, truth: F64, known: Bool, sigma: F32 | None = None, share: float = 1.0) -> float:
    """Print errors of the best `share` of all pixels with truth; returns the share that has a disparity."""
    used = known & np.isfinite(found)
    if sigma is not None and share < 1:
        order = np.sort(sigma[used])
        used &= sigma <= order[min(int(share * known.sum()), len(order) - 1)]
    error = np.abs(found - truth)[used]
    density = used.sum() / known.sum()
    text = f"{name:26} median {np.median(error):.3f} px, beyond 2 px {100 * (error > 2).mean():4.1f} %"
    text += f", density {100 * density:.1f} %"
    if sigma is not None:
        text += f", within one standard deviation {100 * (error <= sigma[used]).mean():.1f} %"
    print(text, flush=True)
    return float(density)


def pair(name: str, left: U8, right: U8, truth: F64, known: Bool, count: int) -> None:
    """OpenCV's matcher and ours on one pair."""
    began = time.process_time()
    base = sgbm(left, right, count)
    took = time.process_time() - began
    density = row(f"{name} SGBM", base, truth, known)
    disparities(left[:64], right[:64], count)  # compile
    began = time.process_time()
    found, sigma = disparities(left, right, count)
    ours = time.process_time() - began
    row(f"{name} ours", found, truth, known, sigma)
    row(f"{name} ours, same density", found, truth, known, sigma, density)
    print(f"{name}: processor time {1e3 * took:.0f} ms and {1e3 * ours:.0f} ms")


def middlebury(folder: Path) -> None:
    """Motorcycle, 741x500."""
    left, right = (cv2.imread(str(folder / f"motorcycle_{side}.png"), 0) for side in ("left", "right"))
    assert left is not None and right is not None
    with np.load(folder / "motorcycle_disp.npz") as data:
        truth = data[data.files[0]].astype(float)
    pair("motorcycle", left, right, truth, np.isfinite(truth) & (truth > 0), 80)


def aloe(folder: Path) -> None:
    """Aloe, 1282x1110, truth in whole pixels."""
    left, right, truth = (cv2.imread(str(folder / name), 0) for name in ("aloeL.jpg", "aloeR.jpg", "aloeGT.png"))
    assert left is not None and right is not None and truth is not None
    pair("aloe", left, right, truth.astype(float), truth > 0, 224)


def store_pairs(folder: Path, count: int) -> None:
    """Ranges of rendered fisheye pairs within `NEAR_M`, of the single pair."""
    rig = json.loads((folder / "rig.json").read_text())
    cameras = [
        KannalaBrandt(rig["width"], rig["height"], c["fx"], c["fy"], c["cx"], c["cy"], tuple(c["k"]))
        for c in (rig["left"], rig["right"])
    ]
    view = stereo_view(Rig(cameras[0], cameras[1], np.array(rig["left_T_right"])))
    uv = cameras[0].project(view.camera.bearing_grid() @ view.cam_R_view.T)
    at = np.nan_to_num(uv, nan=-9).astype(np.float32)
    errors, base_errors, held, coverage = [], [], [], []
    paired: list[F64] = []  # (2, N) relative errors, signed, where both have a range
    for path in sorted((folder / "left").iterdir())[:: max(1, PAIRS // count)]:
        left, right = (cv2.imread(str(folder / side / path.name), 0) for side in ("left", "right"))
        stored = cv2.imread(str(folder / "range" / f"{path.stem}.png"), cv2.IMREAD_UNCHANGED)
        assert left is not None and right is not None and stored is not None
        truth = cv2.remap(stored, at[..., 0], at[..., 1], cv2.INTER_NEAREST) * 0.25e-3
        truth[truth == 0] = np.nan
        near = truth < NEAR_M
        depth = pair_depth(view, left, right)
        base = view.ranges(sgbm(*view.images(left, right), view.disparities))
        known = near & np.isfinite(depth.ranges)
        errors.append(np.abs(depth.ranges / truth - 1)[known])
        held.append((np.abs(depth.ranges - truth) <= depth.sigmas)[known])
        both = near & np.isfinite(base)
        base_errors.append(np.abs(base / truth - 1)[both])
        paired.append(np.stack([depth.ranges / truth - 1, base / truth - 1])[:, known & both])
        coverage.append((known.sum() / near.sum(), both.sum() / near.sum()))
    ours, base = np.concatenate(errors), np.concatenate(base_errors)
    density = 100 * np.mean(coverage, axis=0)
    print(f"store_pairs within {NEAR_M:g} m, {len(errors)} pairs:")
    for name, found, d in (("ours", ours, density[0]), ("SGBM", base, density[1])):
        print(
            f"  {name}: median {100 * np.median(found):.2f} %, 90 % below {100 * np.quantile(found, 0.9):.2f} %", end=""
        )
        print(f", density {d:.1f} %")
    ours, base = np.concatenate(paired, axis=1)
    for name, found in (("ours", ours), ("SGBM", base)):
        print(
            f"  {name}, where both have a range: median {100 * np.median(np.abs(found)):.2f} %"
            f", median with its sign {100 * np.median(found):+.2f} %"
        )
    print(f"  within one standard deviation {100 * np.concatenate(held).mean():.1f} %")


def main() -> None:
    """Every row whose data is at hand."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--middlebury", type=Path)
    parser.add_argument("--aloe", type=Path)
    parser.add_argument("--pairs", type=int, default=PAIRS, help="of store_pairs, evenly spread (default: all 24)")
    options = parser.parse_args()
    if options.middlebury:
        middlebury(options.middlebury)
    if options.aloe:
        aloe(options.aloe)
    data = Path(os.environ.get("STEREO_SFM_DATA", "../shared/data")) / "store_pairs"
    if data.is_dir():
        store_pairs(data, options.pairs)


if __name__ == "__main__":
    main()
