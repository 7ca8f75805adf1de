"""Errors of the tracker's right pixels where the depth of every pixel is known, and the scale error they cause.

    python benchmarks/stereo_bias.py [--frames N] [--every K] [SOURCE ...]

SOURCE: a simulated scene (default: two stores), or a folder of rendered pairs as `store_pairs` of the data root
(`left/ right/ range/ rig.json`). A right pixel's error is taken along its epipolar curve, positive towards nearer,
against the range at the left pixel. New points are what `StereoMatcher.match` accepts of the corners of an image;
followed ones are found by `follow` from distances that are off by half a percent. Per group: how many, mean and median
in px, share beyond 0.3 px, and the mean relative error of the inverse distance, which biases the scale.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Callable, Iterator
from pathlib import Path

from _sequences import data_root, one_thread

one_thread()

import cv2
import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config, TrackerConfig
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.eval.evaluate import evaluate
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import KannalaBrandt
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.tracking.flow import klt
from stereo_sfm.tracking.flow.corners import corner_mask, detect_corners
from stereo_sfm.tracking.flow.stereo import StereoMatcher
from stereo_sfm.types import F32, F64, U8, Trajectory

SOURCES = ("sim:sparse?seed=0", "sim:sparse?seed=3&walk=3&camera=pinhole", "sim:loop?seed=0")
WINDOW = 15  # px
CLIP = 0.1  # of relative errors
OFF = 0.005  # relative error of the distances with which followed points are predicted
GROUPS: dict[str, tuple[float, ...]] = {
    "disparities in the window, px": (0, 0.5, 1, 2, 4, 99),
    "angle from the axis, deg": (0, 30, 50, 65, 76, 95),
    "slant, px per px": (0, 0.02, 0.05, 0.1, 9),
    "contrast, grey levels": (0, 5, 10, 20, 40, 255),
}
Pair = tuple[U8, U8, F32]  # left, right, range along the left ray in metres, NaN where unknown


def read_pairs(folder: Path) -> tuple[Rig, Iterator[Pair]]:
    """A folder of rendered pairs."""
    stored = json.loads((folder / "rig.json").read_text())
    size = stored["width"], stored["height"]
    left, right = (
        KannalaBrandt(*size, camera["fx"], camera["fy"], camera["cx"], camera["cy"], tuple(camera["k"]))
        for camera in (stored["left"], stored["right"])
    )

    def pairs() -> Iterator[Pair]:
        for path in sorted((folder / "left").iterdir()):
            images = [cv2.imread(str(folder / side / path.name), cv2.IMREAD_GRAYSCALE) for side in ("left", "right")]
            steps = cv2.imread(str(folder / "range" / f"{path.stem}.png"), cv2.IMREAD_UNCHANGED)
            metres = np.where(steps > 0, steps * 0.00025, np.nan).astype(np.float32)
            yield np.asarray(images[0], np.uint8), np.asarray(images[1], np.uint8), metres

    return Rig(left, right, np.array(stored["left_T_right"])), pairs()


def simulated_pairs(source: SimSource, every: int, count: int) -> Iterator[Pair]:
    """Every `every`-th frame with its range."""
    for frame_id in source.frame_ids[::every][:count].tolist():
        image = source.frame(frame_id)
        assert image.right is not None
        yield image.left, image.right, source.clean(frame_id)[0].depth


class Truth:
    """True right pixels by the ranges of one left image."""

    def __init__(self, rig: Rig, metres: F32) -> None:
        assert rig.right is not None
        self._rig, self._right = rig, rig.right
        self._right_T_left = se3.inverse(rig.left_T_right)
        with np.errstate(invalid="ignore", divide="ignore"):
            self._rho = (1.0 / metres).astype(np.float32)
        h, w = metres.shape
        u, v = np.meshgrid(np.arange(float(w)), np.arange(float(h)))
        uv = np.stack([u.ravel(), v.ravel()], 1)
        with np.errstate(invalid="ignore"):
            apart = self.right_pixels(uv, self._rho.ravel().astype(float)) - self.right_pixels(uv, np.zeros(len(uv)))
        self.disparity = np.linalg.norm(apart, axis=1).reshape(h, w).astype(np.float32)

    def right_pixels(self, uv: F64, rho: F64) -> F64:
        """(N, 2) of left pixels (N, 2) at inverse distances (N,)."""
        bearing = self._rig.left.unproject(uv)
        points = bearing @ self._right_T_left[:3, :3].T + rho[:, None] * self._right_T_left[:3, 3]
        return self._right.project(points)

    def at(self, uv: F64) -> tuple[F64, F64]:
        """Right pixels (N, 2) and the unit direction (N, 2) in which nearer points lie."""
        rho = _bilinear(self._rho, uv)
        here = self.right_pixels(uv, rho)
        away = self.right_pixels(uv, rho * 1.001 + 1e-4) - here
        return here, away / np.linalg.norm(away, axis=1, keepdims=True)


def _nearest(image: F32, uv: F64) -> F64:
    u, v = np.rint(uv).astype(np.int64).T
    return image[v, u].astype(float)


def _bilinear(image: F32, uv: F64) -> F64:
    """Interpolated between pixels of similar value, else the nearest pixel's value."""
    u, v = np.floor(uv).astype(np.int64).T
    a, b = (uv - np.floor(uv)).T
    corners = np.stack([image[v, u], image[v, u + 1], image[v + 1, u], image[v + 1, u + 1]]).astype(float)
    mean = (corners * np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])).sum(0)
    return np.where(np.ptp(corners, axis=0) < 0.05 * corners.mean(0), mean, _nearest(image, uv))


def _circumstances(rig: Rig, left: U8, truth: Truth, uv: F64) -> F64:
    """(N, 4) in the order of GROUPS."""
    square = np.ones((WINDOW, WINDOW), np.uint8)
    known = np.nan_to_num(truth.disparity)
    apart = cv2.dilate(known, square) - cv2.erode(known, square)
    slope = np.hypot(*np.gradient(known))
    grey = left.astype(np.float32)
    spread = np.sqrt(np.maximum(cv2.blur(grey**2, (WINDOW, WINDOW)) - cv2.blur(grey, (WINDOW, WINDOW)) ** 2, 0))
    angle = np.degrees(np.arccos(rig.left.unproject(uv)[:, 2]))
    return np.stack([_nearest(apart, uv), angle, _nearest(slope, uv), _nearest(spread, uv)], 1)


def errors(rig: Rig, pairs: Iterator[Pair]) -> dict[str, F64]:
    """By kind of point (N, 6): error in px, disparity in px, and the four circumstances."""
    config, out = TrackerConfig(), {"new": list[F64](), "followed": list[F64]()}
    mask, matcher = corner_mask(rig.left, config.max_angle_deg), StereoMatcher(TrackerConfig(), rig)
    spacing = 0.75 * np.sqrt(4.0 * mask.sum() / config.max_features)
    for n, (left, right, metres) in enumerate(pairs):
        pyramids = klt.build_pyramid(left, config.pyramid_levels), klt.build_pyramid(right, 2)
        truth = Truth(rig, metres)
        uv = detect_corners(pyramids[0][1], mask, np.zeros((0, 2)), config.max_features, spacing, config.corner_quality)
        exact, nearer = truth.at(uv)
        match = matcher.match(*pyramids, uv)
        off = np.random.default_rng(n).normal(1, OFF, len(uv))
        rho = _bilinear(1 / metres, uv)
        points = rig.left.unproject(uv) / rho[:, None]
        followed = matcher.follow(*pyramids, uv, points * off[:, None], np.eye(4), np.zeros_like(uv))
        beside = np.column_stack([_nearest(truth.disparity, uv), _circumstances(rig, left, truth, uv)])
        for kind, found in (("new", np.where(match.good[:, None], match.uv_right, np.nan)), ("followed", followed)):
            error = ((found - exact) * nearer).sum(1)
            rows = np.column_stack([error, beside])
            out[kind].append(rows[np.isfinite(rows).all(1) & (beside[:, 0] > 0)])
    return {kind: np.concatenate(rows) for kind, rows in out.items()}


def line(label: str, rows: F64) -> str:
    """One row of the table."""
    error, relative = rows[:, 0], np.clip(rows[:, 0] / rows[:, 1], -CLIP, CLIP)
    doubt = relative.std() / np.sqrt(len(rows))
    return (
        f"| {label} | {len(rows)} | {np.clip(error, -2, 2).mean():+.3f} | {np.median(error):+.3f} "
        f"| {100 * (np.abs(error) > 0.3).mean():.1f} % | {100 * relative.mean():+.2f} ± {100 * doubt:.2f} % |"
    )


def table(name: str, found: dict[str, F64]) -> None:
    """Print the results of one source."""
    print(
        f"\n{name}\n\n| points | number | mean px | median px | beyond 0.3 px | relative |\n|---|---|---|---|---|---|"
    )
    for kind, rows in found.items():
        print(line(f"{kind}, all", rows))
        for column, (group, edges) in enumerate(GROUPS.items(), start=2):
            for low, high in itertools.pairwise(edges):
                inside = rows[(rows[:, column] >= low) & (rows[:, column] < high)]
                if len(inside) >= 20:
                    print(line(f"{kind}, {group} {low:g} to {high:g}", inside))


def scale_error(make_source: Callable[[], SimSource], every: int, frames: int) -> str:
    """Of odometry alone, in percent of the path; below 0 is too short."""
    stamps, poses = list[int](), list[F64]()
    with make_source() as source:
        tracker = make_tracker(Config(), source.rig)
        for frame_id in source.frame_ids[::every][:frames].tolist():
            frame, _ = tracker.step(source.frame(frame_id))
            stamps.append(frame.stamp_ns)
            poses.append(frame.odom_T_cam)
        assert source.ground_truth is not None
        result = evaluate(Trajectory(np.array(stamps), np.array(poses)), source.ground_truth)
    return (
        f"{100 * (1 / result.sim3_scale - 1):+.3f} % over {result.length_m:.1f} m, ATE {1e3 * result.ape_m.rmse:.1f} mm"
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", nargs="*", help="simulated scenes, or folders of rendered pairs")
    parser.add_argument("--frames", type=int, default=300, help="of odometry on simulated scenes; 0: none")
    parser.add_argument("--every", type=int, default=3, help="frames of the source a frame of odometry")
    args = parser.parse_args()
    root = data_root()
    pairs = [str(root / "store_pairs")] if root is not None and (root / "store_pairs").is_dir() else []
    for spec in args.source or [*SOURCES, *pairs]:
        if not spec.startswith("sim:"):
            table(spec, errors(*read_pairs(Path(spec))))
            continue

        def opened(spec: str = spec) -> SimSource:
            source = open_source(spec)
            assert isinstance(source, SimSource)
            return source

        with opened() as source:
            table(spec, errors(source.rig, simulated_pairs(source, 40, 12)))
        if args.frames:
            print(f"\nodometry alone: scale {scale_error(opened, args.every, args.frames)}", flush=True)


if __name__ == "__main__":
    main()
