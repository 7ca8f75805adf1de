"""Rows of `benchmarks dense` from single pairs with ground truth, beside OpenCV's matcher alone, and of live depth."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from _verdicts import Verdicts
from pipeline import RATE, Numbers, opened

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config, DenseConfig
from stereo_sfm.dense.depth import disparities, pair_depth
from stereo_sfm.dense.live import LiveDepthMaker
from stereo_sfm.dense.views import stereo_view
from stereo_sfm.drivers.choice import MadeSource
from stereo_sfm.geometry.cameras import KannalaBrandt
from stereo_sfm.pipeline.processes import ProcessRun
from stereo_sfm.types import F32, F64, U8, Bool, StereoImage

PAIRS = 24  # in store_pairs
NEAR_M = 2.5  # shelves as a robot sees them
SIGMAS = 61, 75  # percent of errors within one standard deviation: 68 +- 7
RATE_HZ = 5  # of live depth
BLOCK = 150  # images, with or without live depth in turn
LAP = 5 * BLOCK  # of a sequence there and back; an odd number of blocks, so that two laps have each image both ways
LAPS = 9  # the first makes the map, and is not counted


def sgbm(left: U8, right: U8, count: int) -> F32:
    """OpenCV's matcher as its examples use it."""
    matcher = cv2.StereoSGBM.create(0, count, 5, 200, 800, 1, 0, 10, 100, 2, cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    found = np.asarray(matcher.compute(left, right)).astype(np.float32) / 16
    found[found < 0] = np.nan
    return found


def _pair(
    verdicts: Verdicts, name: str, images: tuple[U8, U8], truth: F64, count: int, goal: tuple[float, float]
) -> None:
    """Both matchers on one pair. Args: truth, (H, W) px, 0 or not finite where unknown. goal: px, % beyond 2 px."""
    known = np.isfinite(truth) & (truth > 0)
    base = sgbm(*images, count)
    found, sigma = disparities(*images, count)
    both = known & np.isfinite(base)
    used = known & np.isfinite(found)
    least = np.sort(sigma[used])[: int(both.sum())][-1]  # the same density
    error, other = np.abs(found - truth)[used & (sigma <= least)], np.abs(base - truth)[both]
    for what, most, (ours, theirs) in (
        (f"median ≤ {goal[0]} px", goal[0], (float(np.median(e)) for e in (error, other))),
        (f"≤ {goal[1]} % beyond 2 px", goal[1], (100 * float((e > 2).mean()) for e in (error, other))),
    ):
        density = 100 * both.sum() / known.sum()
        text = f"{ours:.3f} at {density:.0f} % density; SGBM {theirs:.3f}"
        verdicts.row(f"{name}: {what}", ours <= most, text)
    if (truth[known] == np.rint(truth[known])).all():
        shares = [100 * float((np.rint(d) == truth)[used & both].mean()) for d in (found, base)]
        text = f"{shares[0]:.1f} %; SGBM {shares[1]:.1f} %"
        verdicts.row(f"{name}: rounded as its truth is, more pixels right than SGBM's", shares[0] > shares[1], text)
        return  # rounding hides its standard deviations
    _held(verdicts, name, np.abs(found - truth)[used] <= sigma[used])


def _held(verdicts: Verdicts, name: str, held: Bool) -> None:
    share = 100 * float(held.mean())
    verdicts.row(f"{name}: 68 ± 7 % within one standard deviation", SIGMAS[0] <= share <= SIGMAS[1], f"{share:.1f} %")


def motorcycle(verdicts: Verdicts, folder: Path) -> None:
    """741x500 px."""
    with np.load(folder / "motorcycle_disp.npz") as data:
        truth = data[data.files[0]].astype(float)
    images = _grey(folder / "motorcycle_left.png"), _grey(folder / "motorcycle_right.png")
    _pair(verdicts, "motorcycle", images, truth, 80, (0.15, 5))


def aloe(verdicts: Verdicts, folder: Path) -> None:
    """1282x1110 px, truth in whole pixels: exact disparities have a median error of 0.25 px."""
    images = _grey(folder / "aloeL.jpg"), _grey(folder / "aloeR.jpg")
    _pair(verdicts, "aloe", images, _grey(folder / "aloeGT.png").astype(float), 224, (0.22, 3))


def store_pairs(verdicts: Verdicts, folder: Path, count: int) -> None:
    """Ranges of rendered fisheye pairs within `NEAR_M`, of the single pair."""
    rig = _rig(folder)
    view = stereo_view(rig)
    uv = rig.left.project(view.camera.bearing_grid() @ view.cam_R_view.T)
    at = np.nan_to_num(uv, nan=-9).astype(np.float32)
    errors: list[list[F64]] = [[], []]
    held: list[Bool] = []
    near_pixels = 0
    for path in _names(folder, count):
        left, right = (_grey(folder / side / path.name) for side in ("left", "right"))
        stored = cv2.imread(str(folder / "range" / f"{path.stem}.png"), cv2.IMREAD_UNCHANGED)
        assert stored is not None
        truth = cv2.remap(stored, at[..., 0], at[..., 1], cv2.INTER_NEAREST) * 0.25e-3
        near = (truth > 0) & (truth < NEAR_M)
        near_pixels += int(near.sum())
        depth = pair_depth(view, left, right)
        base = view.ranges(sgbm(*view.images(left, right), view.disparities))
        for kept, ranges in zip(errors, (depth.ranges, base), strict=True):
            kept.append(np.abs(ranges[near] / truth[near] - 1)[np.isfinite(ranges[near])])
        known = near & np.isfinite(depth.ranges)
        held.append((np.abs(depth.ranges - truth) <= depth.sigmas)[known])
    ours, theirs = (np.concatenate(kept) for kept in errors)
    name = f"store_pairs, {len(held)} pairs"
    text = "{:.2f} % at {:.0f} % density".format
    figures = [text(100 * np.median(e), 100 * len(e) / near_pixels) for e in (ours, theirs)]
    middle = 100 * float(np.median(ours))
    verdicts.row(f"{name}: median ≤ 2 % within 2.5 m", middle <= 2, f"{figures[0]}; SGBM {figures[1]}")
    _held(verdicts, name, np.concatenate(held))


def live(verdicts: Verdicts, folder: Path, count: int) -> None:
    """Processor time of live depth at half the resolution, 424x400."""
    maker = LiveDepthMaker(_rig(folder), DenseConfig(live=True))
    times: list[float] = []
    for k, path in enumerate(_names(folder, count)):
        left, right = (_grey(folder / side / path.name) for side in ("left", "right"))
        began = time.process_time()
        maker.step(StereoImage(k, k, left, right))
        times.append(time.process_time() - began)
    share = 100 * RATE_HZ * float(np.median(times[1:]))  # the first compiles
    verdicts.row("live depth 424x400 at 5 Hz: ≤ 25 % of a core", share <= 25, f"{share:.0f} %")


def latencies(verdicts: Verdicts) -> None:
    """Of the poses of one run in real time, each image as often with live depth as without."""
    source = MadeSource.of(opened, f"sim:loop?frames={LAP // 2 + 1}", LAPS * LAP, True)
    on = np.arange(LAPS * LAP) // BLOCK % 2 == 1
    chosen = frozenset(k for k in np.flatnonzero(on).tolist() if k % round(RATE / RATE_HZ) == 0)
    numbers = Numbers()
    with ProcessRun(source, Config(dense=DenseConfig(live=True)), [numbers], depth_frames=chosen) as run:
        for _ in run:
            pass
    ms = numbers.ms["latency"]
    known = [k for k in ms if k >= LAP]
    without, with_it = ([ms[k] for k in known if on[k] == depth] for depth in (False, True))
    print(f"{len(numbers.ms['depth'])} of {len(chosen)} depth images, {numbers.dropped} dropped", file=sys.stderr)
    for what, percent, most in ("at the median", 50, 1), ("at 95 %", 95, 3):
        a, b = np.percentile(without, percent), np.percentile(with_it, percent)
        verdicts.row(
            f"poses beside live depth: ≤ {most} ms later {what}", bool(b - a <= most), f"{b:.2f} ms; alone {a:.2f} ms"
        )


def _names(folder: Path, count: int) -> list[Path]:
    """`count` of the left images, evenly spread."""
    return sorted((folder / "left").iterdir())[:: max(1, PAIRS // count)]


def _rig(folder: Path) -> Rig:
    rig = json.loads((folder / "rig.json").read_text())
    cameras = [
        KannalaBrandt(rig["width"], rig["height"], c["fx"], c["fy"], c["cx"], c["cy"], tuple(c["k"]))
        for c in (rig["left"], rig["right"])
    ]
    return Rig(cameras[0], cameras[1], np.array(rig["left_T_right"]))


def _grey(path: Path) -> U8:
    image: Any = cv2.imread(str(path), 0)
    assert image is not None, path
    return image
