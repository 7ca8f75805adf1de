"""People in front of the camera: tracking while they fill the view, and recovery after they covered it.

Every kind of encounter of the simulator (`sim:...?encounters=KIND`), for the fisheye and the pinhole pair at 30 and 15
frames a second, images of the camera's own size (`--half-size`: of half of it, in a fourth of the time), 0.8 m/s. An
encounter that takes more than 60 % of the view of a camera counts as covering. Of those the table has the number
recovered in the same submap within 0.5 s of an unobstructed view, the median and largest error of the motion since,
and the number recovered at a wrong place; those that cover for more than 3 s are counted apart and not judged, but for
a wrong place. Of the others: lost frames, steps that are wrong by more than 10 mm or 0.2 degrees while the state says
OK, and the error of the frame poses compared with the same drive without people. Below the table: for each kind, camera
and rate, and for all kinds together, how often each requirement was met, and a table of the encounters that passed:
recovered in time with at most 30 mm and 0.3 degrees of error, or never lost and without a wrong step.

Then the same in recordings with exact poses, into which people and bags are painted (`_occluders.py`): as recorded, and
as a pinhole camera would have seen what a fisheye saw.

    python benchmarks/people.py [--count 30] [--kinds approach,cover] [--cameras fisheye] [--rates 15] [--half-size]
        [--rays 4]
    python benchmarks/people.py --cameras "" --recordings store_walk,store_walk:pinhole,euroc_mh01
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, fields
from functools import cache
from itertools import count
from pathlib import Path

from _sequences import data_root, one_thread

one_thread()

import cv2
import numpy as np
from _occluders import KINDS as PAINTED_KINDS
from _occluders import Painted, PaintedEncounter, PinholeView

from stereo_sfm.config import load
from stereo_sfm.drivers.sim.encounters import KINDS, Encounter
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.eval.evaluate import evaluate
from stereo_sfm.geometry import se3
from stereo_sfm.pipeline.run import run
from stereo_sfm.types import F64, Frame, TrackState, Trajectory

VISION = load(None, ["tracker.inertial=false"])
HALF = {"fisheye": "424x400", "pinhole": "320x200"}
SCENES = {"beside": "sim:loop?length=24"}  # 20 s need a longer route than an aisle
FREE, COVERING = 0.05, 0.6  # share of the view
SOON_S = 0.5
TRACKED = (TrackState.OK, TrackState.RECOVERED)
WRONG_M, WRONG_DEG = 0.5, 10.0  # a larger error after recovery is another place
STEP_MM, STEP_DEG = 10.0, 0.2
AGAIN_M, AGAIN_DEG = 0.03, 0.3  # error over the time that the view was covered
LONG_S = 3.0  # a view covered for longer need not be found again
TIMES = 2.0  # the error without people


@dataclass
class Numbers:
    """Results of one kind of encounter."""

    covering: int = 0
    found: int = 0  # where it was
    wrong: int = 0
    metres: list[float] = field(default_factory=list[float])
    degrees: list[float] = field(default_factory=list[float])
    long: int = 0  # covered for too long to be judged
    long_found: int = 0
    partly: int = 0
    lost: int = 0
    steps: int = 0
    exact: int = 0  # found again with little error
    never_lost: int = 0
    right: int = 0  # encounters without a wrong step
    passed: int = 0  # of both sorts
    errors: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])  # with and without people

    @property
    def count(self) -> int:
        """Encounters."""
        return self.judged + self.long

    @property
    def judged(self) -> int:
        """Encounters that do not cover the view for too long."""
        return self.covering + self.partly

    def add(self, other: Numbers) -> None:
        """Those of other encounters."""
        for f in fields(self):
            setattr(self, f.name, getattr(self, f.name) + getattr(other, f.name))

    def held(self) -> str:
        """How often each of the things held that must hold."""
        near = sum(with_people <= TIMES * without for with_people, without in self.errors)
        covered = (
            f"covered: found again within {SOON_S} s {self.found} of {self.covering}, within {1e3 * AGAIN_M:.0f} mm and"
            f" {AGAIN_DEG} deg {self.exact} of {self.covering}, at a wrong place {self.wrong} of {self.covering}"
        )
        partly = (
            f"in part: never lost {self.never_lost} of {self.partly}, no wrong step {self.right} of {self.partly},"
            f" error at most {TIMES:.0f} times that without people in {near} of {len(self.errors)} drives"
        )
        long = f"covered for more than {LONG_S:.0f} s: found again {self.long_found} of {self.long}"
        return "; ".join([covered] * bool(self.covering) + [long] * bool(self.long) + [partly] * bool(self.partly))

    def row(self, name: str) -> str:
        """A line of the table."""
        off = f"{_of(self.metres, 1e3)} | {_of(self.degrees, 1)}"
        covered = f"| {self.found} of {self.covering} | {off} | {self.wrong} "
        with_people, without = np.array(self.errors).reshape(-1, 2).T
        errors = f"{_of(with_people.tolist(), 1e3)} | {_of(without.tolist(), 1e3)}"
        return f"| {name} {covered}| {self.partly} | {self.lost} | {self.steps} | {errors} |"


def _of(values: list[float], scale: float) -> str:
    """Median and largest."""
    return f"{scale * np.median(values):.2g} ({scale * max(values):.2g})" if values else "–"


Drive = SimSource | Painted


def drive(spec: str) -> tuple[SimSource, list[Frame]]:
    """The frames of one simulated drive, with mapping and loops."""
    cv2.setRNGSeed(0)
    with open_source(spec) as source:
        assert isinstance(source, SimSource)
        return source, list(run(source, VISION))


def painted(recording: str, kind: str, seed: int) -> tuple[Painted, list[Frame]]:
    """The frames of a recording (FOLDER or FOLDER:pinhole) with encounters painted in; without any if `kind` is ""."""
    folder, _, view = recording.partition(":")
    root = data_root()
    inner = open_source(str((root or Path()) / folder))
    cv2.setRNGSeed(0)
    with Painted(PinholeView(inner) if view else inner, kind, seed) as source:
        return source, list(run(source, VISION))


def rate_of(source: Drive) -> float:
    """Images a second."""
    return source.options.rate if isinstance(source, SimSource) else source.rate


def motion_error(source: Drive, a: Frame, b: Frame) -> tuple[float, float]:
    """Metres and degrees by which the motion from frame a to b is wrong."""
    true = se3.inverse(source.pose(a.frame_id)) @ source.pose(b.frame_id)
    metres, radians = se3.extent(se3.inverse(true) @ se3.inverse(a.odom_T_cam) @ b.odom_T_cam)
    return float(metres), float(np.rad2deg(radians))


def judge(source: Drive, frames: list[Frame], encounter: Encounter | PaintedEncounter, numbers: Numbers) -> None:
    """Add one encounter."""
    rate = rate_of(source)
    first, last = (int(np.clip(s * rate, 1, len(frames) - 1)) for s in (encounter.begin, encounter.end))
    shares = np.array([source.moving_share(k).max() for k in range(first, last + 1)])
    if shares.max() > COVERING:
        seen = np.flatnonzero(shares > FREE)
        long = np.count_nonzero(shares > COVERING) > LONG_S * rate
        _covered(source, frames, first + int(seen[0]), first + int(seen[-1]), long, numbers)
        return
    numbers.partly += 1
    lost, steps = numbers.lost, numbers.steps
    for before, after in zip(frames[first - 1 : last], frames[first : last + 1], strict=True):
        numbers.lost += after.state not in TRACKED
        if before.state == after.state == TrackState.OK:
            metres, degrees = motion_error(source, before, after)
            numbers.steps += 1e3 * metres > STEP_MM or degrees > STEP_DEG
    numbers.never_lost += numbers.lost == lost
    numbers.right += numbers.steps == steps
    numbers.passed += (numbers.lost, numbers.steps) == (lost, steps)


def _covered(source: Drive, frames: list[Frame], begin: int, end: int, long: bool, numbers: Numbers) -> None:
    """An encounter that takes (nearly) all of the view; people are there from frame `begin` to `end`."""
    soon = frames[begin : min(end + 1 + round(SOON_S * rate_of(source)), len(frames) - 1) + 1]
    found = soon[-1].state in TRACKED and all(frame.state != TrackState.RESTARTED for frame in soon)
    metres, degrees = motion_error(source, frames[begin - 1], soon[-1])
    wrong = found and (metres > WRONG_M or degrees > WRONG_DEG)
    numbers.wrong += wrong
    if long:
        numbers.long += 1
        numbers.long_found += found and not wrong
        return
    numbers.covering += 1
    if found:
        exact = metres <= AGAIN_M and degrees <= AGAIN_DEG
        numbers.found += not wrong
        numbers.exact += exact
        numbers.passed += exact
        numbers.metres.append(metres)
        numbers.degrees.append(degrees)


def position_error(source: Drive, frames: list[Frame]) -> float:
    """RMSE of the positions of a drive's frame poses, aligned."""
    stamps = np.array([frame.stamp_ns for frame in frames], np.int64)
    poses: F64 = np.array([frame.odom_T_cam for frame in frames])
    assert source.ground_truth is not None
    return evaluate(Trajectory(stamps, poses), source.ground_truth).ape_m.rmse


@cache
def error_alone(spec: str) -> float:
    """`position_error` of a simulated drive without people."""
    return position_error(*drive(spec))


def encounters(kind: str, camera: str, rate: int, count: int, images: str) -> Numbers:
    """Drives with that many encounters in total; `images`: options of the simulator."""
    numbers, seed = Numbers(), 0
    while numbers.count < count:
        scene = SCENES.get(kind, "sim:aisle?returns=off")
        spec = f"{scene}&camera={camera}&rate={rate}&speed=0.8&seed={seed}{images}"
        source, frames = drive(f"{spec}&encounters={kind}")
        partly, chosen = numbers.partly, source.encounters[: count - numbers.count]
        for encounter in chosen:
            judge(source, frames, encounter, numbers)
        if numbers.partly == partly + len(chosen):
            numbers.errors.append((position_error(source, frames), error_alone(spec)))
        seed += 1
    return numbers


def painted_encounters(recording: str, kind: str, wanted: int, alone: float) -> Numbers:
    """Encounters in a recording; `alone`: its error without people."""
    numbers = Numbers()
    for seed in count():
        source, frames = painted(recording, kind, seed)
        for encounter in source.encounters[: wanted - numbers.count]:
            judge(source, frames, encounter, numbers)
        if source.encounters:
            numbers.errors.append((position_error(source, frames), alone))
        if numbers.count >= wanted:
            return numbers
    raise AssertionError


def print_passed(passed: dict[str, dict[str, str]]) -> None:
    """The table of the encounters that passed, by kind and by camera and rate, or recording."""
    columns = list(dict.fromkeys(column for row in passed.values() for column in row))
    print("| passed | " + " | ".join(columns) + " |")
    print("|---" * (len(columns) + 1) + "|")
    for kind, row in passed.items():
        print(f"| {kind} | " + " | ".join(row.get(column, "–") for column in columns) + " |")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=30, help="encounters of each kind")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--cameras", default="fisheye,pinhole")
    parser.add_argument("--rates", default="30,15")
    parser.add_argument("--half-size", action="store_true")
    parser.add_argument(
        "--rays", type=int, default=1, help="of a pixel, squared: 4 are exact to 0.02 px, in nine times the time"
    )
    parser.add_argument("--recordings", default="store_walk,store_walk:pinhole,euroc_mh01")
    args = parser.parse_args()
    print(
        "| encounters | found again | mm: median (most) | deg | wrong place | partly | lost frames | wrong steps"
        " | error mm: median (most) | without people |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    held: list[str] = []
    passed: dict[str, dict[str, str]] = {}  # by kind, then by camera and rate or recording
    for camera in filter(None, args.cameras.split(",")):
        images = f"&rays={args.rays}" + (f"&size={HALF[camera]}" if args.half_size else "")
        for rate in map(int, args.rates.split(",")):
            together = Numbers()
            for kind in args.kinds.split(","):
                numbers = encounters(kind, camera, rate, args.count, images)
                print(numbers.row(f"{kind}, {camera}, {rate} Hz"), flush=True)
                held.append(f"{kind}, {camera}, {rate} Hz: {numbers.held()}")
                passed.setdefault(kind, {})[f"{camera}, {rate} Hz"] = f"{numbers.passed} of {numbers.judged}"
                together.add(numbers)
            held.append(f"all, {camera}, {rate} Hz: {together.held()}")
    for recording in filter(None, args.recordings.split(",")):
        alone = position_error(*painted(recording, "", 0))
        for kind in (kind for kind in PAINTED_KINDS if kind in args.kinds.split(",")):
            numbers = painted_encounters(recording, kind, args.count, alone)
            print(numbers.row(f"{kind}, {recording}"), flush=True)
            held.append(f"{kind}, {recording}: {numbers.held()}")
            passed.setdefault(kind, {})[recording] = f"{numbers.passed} of {numbers.judged}"
    print("\n" + "\n".join(held) + "\n")
    print_passed(passed)


if __name__ == "__main__":
    main()
