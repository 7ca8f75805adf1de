"""Up and down one aisle: loops, merging and relocalization across directions of travel.

    python benchmarks/both_directions.py --stores 10
    python benchmarks/both_directions.py --stores 3 --size 424x400 --rate 15
    python benchmarks/both_directions.py --stores 10 --camera pinhole

For each store of `sim:aisle`: one run up the aisle of 12 m and down again (joined: a loop within 15 cm of the truth
leads across directions); two sessions, one up and one down, each with its own sway and noise, merged; single images of
the way down asked in the map of the way up. For each store of `sim:identical-aisles`, one run through all aisles by
turns in both directions: no loop may be off by more than 30 cm.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass

from _sequences import one_thread

one_thread()

import numpy as np

from stereo_sfm.config import Config
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval.record import Closure, RunRecord
from stereo_sfm.geometry import se3
from stereo_sfm.loop.vocabulary_file import default_vocabulary
from stereo_sfm.mapping.mapper import Mapper
from stereo_sfm.maps.cameras import MapCamera
from stereo_sfm.maps.merge import merge
from stereo_sfm.maps.relocalization import Relocalizer
from stereo_sfm.maps.saved_map import SavedMap
from stereo_sfm.maps.single_image import still_keyframe
from stereo_sfm.pipeline.inline import InlineRun
from stereo_sfm.types import F64

OTHER_SESSION = 4  # `walk` of another session in the same aisle
TURNED_DEG = 90.0  # between the headings of a loop's sides, for it to lead across directions
RIGHT_M, FALSE_M = 0.15, 0.3
GOOD_M, GOOD_DEG = 0.05, 1.0


@dataclass(frozen=True, eq=False)
class Drive:
    """A finished run."""

    saved: SavedMap
    loops: list[Closure]
    estimate: F64  # (N, 4, 4) map_T_cam of all frames
    truth: F64  # (N, 4, 4) world_T_cam of the same frames
    true_kf: dict[int, F64]  # world_T_cam by keyframe

    @property
    def end_error(self) -> float:
        """Metres between the end points when the starts are laid on each other."""
        a, b = (se3.inverse(poses[0]) @ poses[-1] for poses in (self.estimate, self.truth))
        return float(np.linalg.norm(a[:3, 3] - b[:3, 3]))


def drive(spec: str, part: slice = slice(None)) -> Drive:
    """Run over some of a source's frames."""
    with open_source(spec) as source:
        assert isinstance(source, SimSource) and source.ground_truth is not None
        record = RunRecord.of(Config())
        run = InlineRun(source, Config(), [record], None)
        for image in source.at(range(*part.indices(len(source.frame_ids)))):
            run.step(image)
        run.finish()
        mapper, rig, truth = run.map_stage.mapper, source.rig, source.ground_truth
    assert isinstance(mapper, Mapper)
    snapshot, trajectory = mapper.map.snapshot(), record.mapped()
    assert trajectory is not None
    by_stamp = dict(zip(truth.stamp_ns.tolist(), truth.poses, strict=True))
    saved = SavedMap.of_session(snapshot, MapCamera(rig), default_vocabulary().id)
    return Drive(
        saved,
        record.loops,
        trajectory.poses,
        np.array([by_stamp[s] for s in trajectory.stamp_ns.tolist()]),
        {k: by_stamp[row.stamp_ns] for k, row in record.keyframes.items()},
    )


def loop_errors(loops: list[Closure], old: dict[int, F64], new: dict[int, F64]) -> list[tuple[float, bool]]:
    """Metres by which each loop is off, and whether it leads across directions."""
    out: list[tuple[float, bool]] = []
    for loop in loops:
        true = se3.inverse(old[loop.candidate_kf_id]) @ new[loop.kf_id]
        off = float(np.linalg.norm((se3.inverse(true) @ loop.candidate_T_kf)[:3, 3]))
        out.append((off, float(np.degrees(se3.extent(true)[1])) > TURNED_DEG))
    return out


def halves(spec: str) -> tuple[slice, slice]:
    """The frames of the way up the aisle and of the way down."""
    with open_source(spec) as source:
        assert source.ground_truth is not None
        ahead = source.ground_truth.poses[:, 0, 2]
        straight = np.abs(ahead) > np.cos(np.deg2rad(10))
        up, down = np.flatnonzero(straight & (ahead > 0)), np.flatnonzero(straight & (ahead < 0))
    return slice(0, int(up[-1]) + 1), slice(int(down[0]), None)


def aligned(map_T_kf: F64, world_T_kf: F64) -> F64:
    """world_T_map (4, 4) by rotations too: positions on a straight line leave the turn about it free."""
    each = world_T_kf @ se3.inverse(map_T_kf)
    u, _, vt = np.linalg.svd(each[:, :3, :3].mean(0))
    rotation = u @ vt
    shift = (world_T_kf[:, :3, 3] - map_T_kf[:, :3, 3] @ rotation.T).mean(0)
    return se3.from_rotation_translation(rotation, shift)


def merged(up: Drive, down: Drive) -> tuple[bool, float]:
    """Whether the two sessions became one map, and the metres by which the second is misplaced."""
    try:
        result = merge([up.saved, down.saved], default_vocabulary(), Config().loop)
    except StereoSfmError:
        return False, float("nan")
    s, offset = result.saved.snapshot, int(up.saved.snapshot.kf_ids.max()) + 1
    true = np.array([up.true_kf[k] if k < offset else down.true_kf[k - offset] for k in s.kf_ids.tolist()])
    first = s.kf_ids < offset
    world_T_map = aligned(s.map_T_kf[first], true[first])
    off = se3.transform(world_T_map, s.map_T_kf[~first, :3, 3]) - true[~first, :3, 3]
    return True, float(np.sqrt((off**2).sum(1).mean()))


def relocalized(up: Drive, spec: str, part: slice, queries: int, seed: int) -> tuple[int, int, int]:
    """Single images of the way down in the map of the way up: good, found, and wrong by more than FALSE_M."""
    s = up.saved.snapshot
    true = np.array([up.true_kf[k] for k in s.kf_ids.tolist()])
    world_T_map = aligned(s.map_T_kf, true)
    relocalizer = Relocalizer(s, up.saved.rig, default_vocabulary(), Config().loop)
    good = found = wrong = 0
    with open_source(spec) as source:
        assert isinstance(source, SimSource) and source.ground_truth is not None
        frames = np.arange(*part.indices(len(source.frame_ids)))
        for k in np.random.default_rng(seed).choice(frames, queries, replace=False).tolist():
            image = next(source.at([k]))
            keyframe = still_keyframe(image, up.saved.rig)
            place = None if keyframe is None else relocalizer.locate(keyframe)
            if place is None or not place.found:
                continue
            error = se3.inverse(source.ground_truth.poses[k]) @ world_T_map @ place.map_T_cam
            metres, radians = (float(x) for x in se3.extent(error))
            found += 1
            good += metres <= GOOD_M and np.degrees(radians) <= GOOD_DEG
            wrong += metres > FALSE_M
    return good, found, wrong


def store(options: str, seed: int, queries: int) -> tuple[bool, bool, float, int, int]:
    """One store: joined, merged, end error, correct relocalizations, and false loops or relocalizations."""
    spec = f"sim:aisle?seed={seed}&length=40{options}"
    other = f"{spec}&walk={OTHER_SESSION}"
    there, back = halves(spec)[0], halves(other)[1]
    both = drive(spec)
    errors = loop_errors(both.loops, both.true_kf, both.true_kf)
    joined = any(off < RIGHT_M and across for off, across in errors)
    false = sum(off > FALSE_M for off, _ in errors)
    up, down = drive(spec, there), drive(other, back)
    one, misplaced = merged(up, down)
    good, found, wrong = relocalized(up, other, back, queries, seed)
    off = ", ".join(f"{1e3 * e:.0f}" for e, across in errors if across) or "none"
    print(
        f"store {seed}: {'joined' if joined else 'NOT joined'} (loops across directions off by mm: {off}), end error"
        f" {1e3 * both.end_error:.1f} mm; {'merged' if one else 'NOT merged'}, the second session {1e3 * misplaced:.1f}"
        f" mm off; {good} of {queries} relocalized ({found} found, {wrong} wrong)",
        flush=True,
    )
    return joined, one, both.end_error, good, false + wrong


def identical(options: str, seed: int) -> int:
    """One store of identical aisles: its false loops."""
    run = drive(f"sim:identical-aisles?seed={seed}{options}")
    errors = loop_errors(run.loops, run.true_kf, run.true_kf)
    false = sum(off > FALSE_M for off, _ in errors)
    print(
        f"identical aisles {seed}: {len(errors)} loops, {sum(across for _, across in errors)} across directions,"
        f" {false} false; end error {1e3 * run.end_error:.1f} mm",
        flush=True,
    )
    return false


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stores", type=int, default=10, help="of sim:aisle")
    parser.add_argument("--identical", type=int, default=-1, help="of sim:identical-aisles; -1: as many")
    parser.add_argument("--first", type=int, default=0, help="seed of the first store")
    parser.add_argument("--queries", type=int, default=20, help="images relocalized in each store")
    parser.add_argument("--camera", default="fisheye")
    parser.add_argument("--size", default="", help="WIDTHxHEIGHT of the images, the camera's own without")
    parser.add_argument("--rate", type=float, default=30.0, help="frames a second")
    args = parser.parse_args()
    options = f"&camera={args.camera}&rate={args.rate}" + (f"&size={args.size}" if args.size else "")
    seeds = range(args.first, args.first + args.stores)
    rows = [store(options, seed, args.queries) for seed in seeds]
    count = args.stores if args.identical < 0 else args.identical
    false = sum(identical(options, seed) for seed in range(args.first, args.first + count))
    if not rows:
        return 3 if false else 0
    joined, one, ends, good, wrong = (np.array(column) for column in zip(*rows, strict=True))
    print(
        f"joined {joined.sum()} of {len(rows)}, merged {one.sum()} of {len(rows)}, relocalized {good.sum()} of"
        f" {len(rows) * args.queries}; end error median {1e3 * np.median(ends):.1f} mm, worst"
        f" {1e3 * ends.max():.1f} mm; {false + wrong.sum()} false loops and relocalizations"
    )
    passed = joined.mean() >= 0.9 and one.mean() >= 0.9 and good.mean() >= 0.8 * args.queries and ends.max() <= 0.03
    return 0 if passed and not false + wrong.sum() else 3


if __name__ == "__main__":
    sys.exit(main())
