"""Every day in one store: sessions put into one map, of which a share of the products is exchanged each night.

    python benchmarks/sessions.py --sessions 50 --size 424x400 --rate 15
    python benchmarks/sessions.py --sessions 6 --size 212x200 --rate 10 --every 1
    python benchmarks/sessions.py --scene market --sessions 3 --every 1 --size 424x400 --rate 10

Before each session is put in (`map update`), single images of it are asked in the map as it is. For every tenth: how
many of them were found within 5 cm and 1 degree, the error of the session in the map (RMSE of its keyframes, the map
laid on the truth), the map's size and the time to open it, and the seconds of the update.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from _sequences import one_thread

one_thread()

import numpy as np
from both_directions import GOOD_DEG, GOOD_M, aligned, drive

from stereo_sfm.config import Config
from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.loop.vocabulary_file import default_vocabulary
from stereo_sfm.maps.relocalization import Relocalizer
from stereo_sfm.maps.saved_map import SavedMap, load_map, save_map
from stereo_sfm.maps.single_image import still_keyframe
from stereo_sfm.maps.update import update
from stereo_sfm.types import F64

WALKS = {"aisle": 4, "loop": 5}  # of these scenes every so manieth session is in the same aisle
FALSE_M = 0.3

Truth = dict[tuple[int, int], F64]  # session and stamp -> world_T_cam


def truth_of(saved: SavedMap, truth: Truth) -> F64:
    """(K, 4, 4) world_T_cam of a map's keyframes."""
    keys = zip(saved.sessions.tolist(), saved.snapshot.stamp_ns.tolist(), strict=True)
    return np.array([truth[key] for key in keys])


@dataclass(frozen=True)
class Asked:
    """How single images of a session were found in a map."""

    good: int = 0
    wrong: int = 0
    median_s: float = 0.0  # processor time of a query
    most_s: float = 0.0

    def __str__(self) -> str:
        times = f"{1e3 * self.median_s:.0f} ms each in the median, {1e3 * self.most_s:.0f} at most"
        return f"{self.good} images found, {self.wrong} wrong, {times}"


def asked(saved: SavedMap, truth: Truth, spec: str, queries: int, seed: int) -> Asked:
    """Single images of a session in the map."""
    s = saved.snapshot
    world_T_map = aligned(s.map_T_kf, truth_of(saved, truth))
    relocalizer = Relocalizer(s, saved.rig, default_vocabulary(), Config().loop)
    good = wrong = 0
    seconds: list[float] = []
    with open_source(spec) as source:
        assert isinstance(source, SimSource) and source.ground_truth is not None
        frames = np.random.default_rng(seed).choice(len(source.frame_ids), queries, replace=False)
        for k in np.sort(frames).tolist():
            keyframe = still_keyframe(next(source.at([k])), saved.rig)
            begin = time.process_time()
            place = None if keyframe is None else relocalizer.locate(keyframe)
            seconds.append(time.process_time() - begin)
            if place is None or not place.found:
                continue
            error = se3.inverse(source.ground_truth.poses[k]) @ world_T_map @ place.map_T_cam
            metres, radians = (float(x) for x in se3.extent(error))
            good += metres <= GOOD_M and np.degrees(radians) <= GOOD_DEG
            wrong += metres > FALSE_M
    return Asked(good, wrong, float(np.median(seconds)), max(seconds))


def session_error(saved: SavedMap, truth: Truth, session: int) -> float:
    """Metres, RMSE of a session's keyframes where the whole map is laid on the truth."""
    true = truth_of(saved, truth)
    poses = aligned(saved.snapshot.map_T_kf, true) @ saved.snapshot.map_T_kf
    off = (poses - true)[saved.sessions == session, :3, 3]
    return float(np.sqrt((off**2).sum(1).mean()))


def on_disk(saved: SavedMap) -> tuple[float, float]:
    """Megabytes of the saved map, and the seconds to open it."""
    with tempfile.TemporaryDirectory() as place:
        save_map(saved, Path(place) / "map")
        size = sum(path.stat().st_size for path in (Path(place) / "map").iterdir())
        begin = time.perf_counter()
        load_map(Path(place) / "map")
        return size / 1e6, time.perf_counter() - begin


def put_in(saved: SavedMap | None, walk: SavedMap) -> tuple[SavedMap, int, int, int]:
    """The map with a session, the session's number in it, loops, and keyframes forgotten; the first begins the map.

    Raises:
        StereoSfmError: no loop joins the session to the map.
    """
    if saved is None:
        return walk, 0, 0, 0
    done = update(saved, walk, default_vocabulary(), Config().loop, Config().mapper)
    return done.saved, done.session, len(done.loops), done.forgotten


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="aisle")
    parser.add_argument("--sessions", type=int, default=50)
    parser.add_argument("--every", type=int, default=10, help="sessions between two lines")
    parser.add_argument("--exchange", type=float, default=0.1, help="share of the products exchanged each night")
    parser.add_argument("--queries", type=int, default=10, help="images asked before a session that is reported")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", default="424x400")
    parser.add_argument("--rate", type=float, default=15.0)
    parser.add_argument("--length", type=float, default=0.0, help="metres of a session, 0: the scene's own")
    args = parser.parse_args()
    saved: SavedMap | None = None
    truth: Truth = {}
    first_good = last_good = -1
    for n in range(args.sessions):
        spec = (
            f"sim:{args.scene}?seed={args.seed}&size={args.size}&rate={args.rate}&length={args.length}"
            f"&walk={n * WALKS.get(args.scene, 1)}&nights={n}&exchange={args.exchange}"
        )
        told = n in (1, args.sessions - 1) or n % args.every == 0
        found = asked(saved, truth, spec, args.queries, n) if saved is not None and told else Asked()
        walk = drive(spec)
        stamps = dict(zip(walk.saved.snapshot.kf_ids.tolist(), walk.saved.snapshot.stamp_ns.tolist(), strict=True))
        begin = time.perf_counter()
        try:
            saved, session, joined, forgotten = put_in(saved, walk.saved)
        except StereoSfmError as error:
            print(f"session {n}: NOT joined ({error})", flush=True)
            continue
        took = time.perf_counter() - begin
        truth |= {(session, stamps[k]): pose for k, pose in walk.true_kf.items() if k in stamps}
        if not told:
            continue
        first_good = found.good if n == 1 else first_good
        last_good = found.good
        megabytes, opening = on_disk(saved)
        print(
            f"session {n}: in the map before, of {args.queries}: {found}; {joined} loops, {forgotten} keyframes"
            f" forgotten; {1e3 * session_error(saved, truth, session):.1f} mm off; {len(saved)} keyframes,"
            f" {len(saved.snapshot.pt_ids)} points, {megabytes:.1f} MB, opened in {opening:.2f} s; update {took:.1f} s",
            flush=True,
        )
    return 0 if last_good >= first_good - 1 else 3


if __name__ == "__main__":
    sys.exit(main())
