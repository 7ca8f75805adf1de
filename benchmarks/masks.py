"""Accuracy with parts of the image masked, and with the robot's own edge in view.

Each seed is another store and another drive with turns (fisheye, half size, 10 frames a second), run three times with
slightly other thresholds:

* `free`: nothing masked, no robot;
* `fifth masked`: a random side of the view, a fifth of its pixels, masked in both cameras;
* `four fifths of the points`: nothing masked, `tracker.max_features` times 0.8: what that mask should cost;
* `robot, no mask`: the robot's edge and a hand rail in view;
* `robot, automatic mask`: the same with the mask that `stereo-sfm mask` makes of this recording;
* `automatic mask, no robot`: that mask where nothing is hidden: what the part of the view is worth.

Per kind: mean and standard error of ATE (SE(3)) of odometry and map, and of their ratio to `free` of the same seed (the
geometric mean), lost frames, and the median number of points.

    python benchmarks/masks.py [--seeds N] [--first SEED] [SOURCE]
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator

from _sequences import one_thread

one_thread()

import numpy as np
from _runs import recorded

from stereo_sfm import config as configuration
from stereo_sfm.calib.mask_search import MaskSearch, masked
from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.source import BaseSource, open_source
from stereo_sfm.eval.evaluate import evaluate, length
from stereo_sfm.tracking.factory import make_tracker
from stereo_sfm.types import F64, Bool, StereoImage, Trajectory

SOURCE = "sim:demo?size=424x400&rate=10&length=14"
SHARE = 0.2  # of the view that is masked
DEFAULT = configuration.Config().tracker
FEWER = f"tracker.max_features={round((1 - SHARE) * DEFAULT.max_features)}"
VARIED = ((1.0, 1.0), (0.97, 1.1), (1.03, 0.9))  # keyframe_share and corner_quality of the runs, over the default


class Rendered(BaseSource):
    """The images of a source in memory, for any calibration."""

    def __init__(self, images: list[StereoImage], truth: Trajectory, rig: Rig) -> None:
        self.name, self.ground_truth, self.rig, self._images = "rendered", truth, rig, images
        self.frame_count = len(images)

    def __iter__(self) -> Iterator[StereoImage]:
        return iter(self._images)

    def with_rig(self, rig: Rig) -> Rendered:
        """The same images."""
        assert self.ground_truth is not None
        return Rendered(self._images, self.ground_truth, rig)


def rendered(spec: str) -> Rendered:
    """All images of a source."""
    with open_source(spec) as source:
        assert source.ground_truth is not None
        return Rendered(list(source), source.ground_truth, source.rig)


def side_masked(rig: Rig, seed: int) -> Rig:
    """The rig with a fifth of the view masked: beyond a line at a random angle, the same in both cameras."""
    angle = np.random.default_rng([seed, 7]).uniform(0, 2 * np.pi)
    assert rig.right is not None
    used: list[Bool] = []
    for camera in (rig.left, rig.right):
        v, u = np.mgrid[0 : camera.height, 0 : camera.width]
        along = np.cos(angle) * (u - camera.cx) + np.sin(angle) * (v - camera.cy)
        used.append(along < np.quantile(along[camera.valid_mask(np.pi / 2)], 1 - SHARE))
    return dataclasses.replace(rig, left_mask=used[0], right_mask=used[1])


def automatically_masked(source: Rendered) -> Rig:
    """The rig with the masks of `stereo-sfm mask`."""
    tracker, search = make_tracker(configuration.Config(), source.rig), MaskSearch()
    for image in source:
        search.add_tracked(image, *tracker.step(image))
    return masked(source.rig, search.find())


def errors(source: Rendered, settings: tuple[str, ...] = ()) -> tuple[float, float, int, float]:
    """ATE of odometry and map in metres, lost frames, median number of points; means and sum over the runs."""
    found = [_run(source, (*settings, *_varied(share, quality))) for share, quality in VARIED]
    alone, together, lost, points = np.array(found).T
    return float(alone.mean()), float(together.mean()), int(lost.sum()), float(points.mean())


def _varied(share: float, quality: float) -> tuple[str, str]:
    keyframes, corners = share * DEFAULT.keyframe_share, quality * DEFAULT.corner_quality
    return f"tracker.keyframe_share={keyframes:.4f}", f"tracker.corner_quality={corners:.5f}"


def _run(source: Rendered, settings: tuple[str, ...]) -> tuple[float, float, int, float]:
    record = recorded(source, configuration.load(None, list(settings)))
    odometry, mapped = record.odometry(), record.mapped()
    assert source.ground_truth is not None and odometry is not None and mapped is not None
    alone, together = (evaluate(t, source.ground_truth).ape_m.rmse for t in (odometry, mapped))
    lost = len(record.frames) - int(record.tracked().sum())
    return alone, together, lost, float(np.median(record.frames.inliers))


def runs(spec: str, seed: int) -> dict[str, tuple[float, float, int, float]]:
    """Errors by kind for one seed."""
    free = rendered(f"{spec}&seed={seed}")
    out = {
        "free": errors(free),
        "fifth masked": errors(free.with_rig(side_masked(free.rig, seed))),
        "four fifths of the points": errors(free, (FEWER,)),
    }
    robot = rendered(f"{spec}&seed={seed}&robot=on")
    out["robot, no mask"] = errors(robot)
    automatic = automatically_masked(robot)
    out["robot, automatic mask"] = errors(robot.with_rig(automatic))
    out["automatic mask, no robot"] = errors(free.with_rig(automatic))
    return out


def _mean(values: F64) -> str:
    return f"{length(float(values.mean()))} ± {length(float(values.std(ddof=1) / np.sqrt(len(values))))}"


def _ratio(values: F64, free: F64) -> str:
    logs = np.log(values / free)
    mean, doubt = logs.mean(), logs.std(ddof=1) / np.sqrt(len(logs))
    return f"{np.exp(mean):.2f} ({np.exp(mean - doubt):.2f}–{np.exp(mean + doubt):.2f})"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default=SOURCE)
    parser.add_argument("--seeds", type=int, default=8, help="at least 2")
    parser.add_argument("--first", type=int, default=0)
    args = parser.parse_args()
    found: list[dict[str, tuple[float, float, int, float]]] = []
    for seed in range(args.first, args.first + args.seeds):
        found.append(runs(args.source, seed))
        cells = (f"{kind}: {1e3 * o:.2f}, {1e3 * m:.2f} mm" for kind, (o, m, *_) in found[-1].items())
        print(f"seed {seed}: {'; '.join(cells)}", flush=True)
    print("| | odometry | of free | map | of free | lost | points |")
    print("|---|---|---|---|---|---|---|")
    free = np.array([one["free"] for one in found])
    for kind in found[0]:
        rows = np.array([one[kind] for one in found])
        cells = [f"{_mean(rows[:, k])} | {_ratio(rows[:, k], free[:, k])}" for k in (0, 1)]
        print(f"| {kind} | {' | '.join(cells)} | {int(rows[:, 2].sum())} | {np.median(rows[:, 3]):.0f} |")


if __name__ == "__main__":
    main()
