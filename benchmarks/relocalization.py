"""Localize-only in a saved map: single stereo images from random places of a sequence, without a prior.

The map is made by a run over the source (or taken from --map), saved, and loaded again. The queries are images from
poses between those of the sequence: shifted by up to 20 cm to the side and turned by up to 10 degrees. A second round
does the same in the store after a fifth of the products was exchanged.

    python benchmarks/relocalization.py
    python benchmarks/relocalization.py --map runs/loop/map "sim:loop"
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from _sequences import one_thread

one_thread()

import numpy as np

from stereo_sfm.config import Config
from stereo_sfm.drivers.sim.effects import Sensor
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.geometry import se3
from stereo_sfm.loop.vocabulary_file import default_vocabulary
from stereo_sfm.mapping.mapper import Mapper
from stereo_sfm.maps.cameras import MapCamera
from stereo_sfm.maps.relocalization import Relocalizer
from stereo_sfm.maps.saved_map import SavedMap, load_map, save_map
from stereo_sfm.maps.single_image import still_keyframe
from stereo_sfm.types import F64, StereoImage

ASIDE_METRES = np.array([0.2, 0.03, 0.2])  # to the side, up or down, ahead or back
TURN_DEGREES = np.array([3.0, 10.0, 3.0])  # pitch, yaw, roll
GOOD_METRES, GOOD_DEGREES, WRONG_METRES = 0.05, 1.0, 0.5


def make_map(spec: str, stored: Path | None) -> SavedMap:
    """Run tracker, mapper and loop closer over the source."""
    from loops import images

    from stereo_sfm.pipeline.inline import InlineRun

    with open_source(spec) as source:
        run = InlineRun(source, Config(), [], None)
        for image in images(source, 0, stored):
            run.step(image)
        run.finish()
        mapper = run.map_stage.mapper
        assert isinstance(mapper, Mapper)
        snapshot = mapper.map.snapshot()
        rig = source.rig
    return SavedMap.of_session(snapshot, MapCamera(rig), default_vocabulary().id)


def alignment(saved: SavedMap, source: SimSource) -> F64:
    """world_T_map (4, 4): aligns the map's keyframes with their true poses."""
    assert source.ground_truth is not None
    truth = dict(zip(source.ground_truth.stamp_ns.tolist(), source.ground_truth.poses, strict=True))
    true = np.array([truth[s] for s in saved.snapshot.stamp_ns.tolist()])
    return se3.umeyama(saved.snapshot.map_T_kf[:, :3, 3], true[:, :3, 3])[0]


def questions(source: SimSource, count: int, seed: int) -> Iterator[tuple[StereoImage, F64]]:
    """Images from random poses near the sequence, and the poses."""
    rng = np.random.default_rng(seed)
    sensors = [Sensor(side, source.effects) for side in source.renderer.cameras]
    for n in range(count):
        pose = source.drive.poses(np.array([rng.uniform(0, source.drive.duration)]))[0]
        shift, turn = rng.uniform(-1, 1, 3) * ASIDE_METRES, np.deg2rad(rng.uniform(-1, 1, 3) * TURN_DEGREES)
        pose = pose @ se3.exp(np.concatenate([shift, turn]))
        views = source.renderer.render(pose)
        left, right = (
            sensor.expose(view, np.zeros(6), 1.0, 2 * n + side)
            for side, (sensor, view) in enumerate(zip(sensors, views, strict=True))
        )
        yield StereoImage(n, n, left, right), pose


def ask(saved: SavedMap, world_T_map: F64, source: SimSource, count: int, seed: int) -> tuple[int, int]:
    """Print one round; returns the numbers of correct and wrong results."""
    relocalizer = Relocalizer(saved.snapshot, saved.rig, default_vocabulary(), Config().loop)
    good = wrong = found = 0
    times: list[float] = []
    errors: list[float] = []
    reasons: Counter[str] = Counter()
    for image, pose in questions(source, count, seed):
        begin = time.perf_counter()
        keyframe = still_keyframe(image, saved.rig)
        location = None if keyframe is None else relocalizer.locate(keyframe)
        times.append(1e3 * (time.perf_counter() - begin))
        if location is None or not location.found:
            reasons[location.reason if location is not None else "too_few_points"] += 1
            continue
        error = se3.inverse(pose) @ world_T_map @ location.map_T_cam
        metres = float(np.linalg.norm(error[:3, 3]))
        degrees = float(np.rad2deg(np.linalg.norm(se3.log(error)[3:])))
        found += 1
        good += metres <= GOOD_METRES and degrees <= GOOD_DEGREES
        wrong += metres > WRONG_METRES
        errors.append(metres)
    worst = f"median {1e3 * np.median(errors):.1f} mm, worst {1e3 * max(errors):.0f} mm" if errors else "none"
    print(
        f"{source.name} exchange={source.options.exchange}: {good} of {count} within 5 cm and 1 degree, {found} found,"
        f" {wrong} wrong by more than 0.5 m; {worst}; {np.median(times):.0f} ms a query (p95"
        f" {np.percentile(times, 95):.0f}); refused: {dict(reasons) or 'none'}",
        flush=True,
    )
    return good, wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default="sim:loop")
    parser.add_argument("--map", type=Path, help="map folder of this source instead of a new run")
    parser.add_argument("--stored", type=Path, help="images (N, 2, H, W) of the source in a .npy file")
    parser.add_argument("--queries", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.map or Path(scratch) / "map"
        if args.map is None:
            save_map(make_map(args.source, args.stored), folder)
        begin = time.perf_counter()
        saved = load_map(folder)
        load_s = time.perf_counter() - begin
        size = sum(path.stat().st_size for path in folder.iterdir())
        held = f"{len(saved)} keyframes, {len(saved.snapshot.points)} points"
        print(f"map: {held}, {size / 1e6:.1f} MB, read in {load_s:.2f} s")
    passed = True
    for exchange, wanted in ((0.0, 0.96), (0.2, 0.8)):
        query = f"{args.source}{'&' if '?' in args.source else '?'}exchange={exchange}"
        with open_source(query) as source:
            assert isinstance(source, SimSource)
            good, wrong = ask(saved, alignment(saved, source), source, args.queries, args.seed)
        passed &= good >= wanted * args.queries and wrong == 0
    return 0 if passed else 3


if __name__ == "__main__":
    sys.exit(main())
