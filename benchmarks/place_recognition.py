"""Place recognition: query time against the number of keyframes, and precision and recall in identical aisles.

The sequences pass every aisle of a store whose aisles have the same products in the same order, and return through the
first one. "Words alone" takes the place with the best score of the bag of words; "words and geometry" adds the
verification; "all" is the loop closer with odometry and agreement of successive keyframes.

`--cut` simulates losses of tracking instead: at five places of each sequence tracking is lost and restarts four
keyframes later in a new submap; the first loop that connects the submaps is counted.

    python benchmarks/place_recognition.py --seeds 10
    python benchmarks/place_recognition.py --cut --seeds 6 "sim:loop?size=424x400"
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import pickle
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from _sequences import one_thread

one_thread()

import numpy as np
from _sparse_sequence import SparseSequence, sequence_keyframes

from stereo_sfm.config import LoopConfig
from stereo_sfm.geometry import se3
from stereo_sfm.loop.closer import LoopCloser
from stereo_sfm.loop.database import PlaceDatabase
from stereo_sfm.loop.vocabulary import Vocabulary
from stereo_sfm.loop.vocabulary_file import default_vocabulary
from stereo_sfm.types import LoopResult

CUTS, LEFT_OUT = (0.08, 0.15, 0.25, 0.5, 0.75), 3  # positions of the losses of tracking, and lost keyframes
FALSE_METRES, FALSE_DEGREES = 0.5, 10.0  # an accepted loop with a larger error is false
NEAR_METRES, NEAR_DEGREES, GAP = (
    1.0,
    25.0,
    12,
)  # a return: largest distance, smallest age in keyframes


@dataclass
class Count:
    """Over all sequences."""

    accepted: int = 0
    false: int = 0
    sequences_with_return: int = 0
    sequences_found: int = 0
    worst_m: float = 0.0
    errors: list[float] = field(default_factory=list[float])

    def row(self, name: str) -> str:
        """A line of the table."""
        true = self.accepted - self.false
        precision = f"{true / self.accepted:9.3f}" if self.accepted else "        -"
        median = f"{1e3 * float(np.median(self.errors)):8.1f}" if self.errors else "       -"
        return (
            f"{name:22s} {self.accepted:8d}  {self.false:5d}  {precision}  {self.sequences_found:5d} of"
            f" {self.sequences_with_return:2d}  {median}  {self.worst_m:8.3f}"
        )


def query_times(vocabulary: Vocabulary, sizes: tuple[int, ...] = (100, 1000, 10_000)) -> None:
    """Milliseconds to look up a keyframe's words, to query the database, and to insert, at three sizes."""
    rng = np.random.default_rng(0)
    leaves = vocabulary.centroids[np.flatnonzero(vocabulary.child_count == 0)]
    looks = np.ascontiguousarray(leaves).view(np.uint8).reshape(-1, 32)

    def keyframe() -> np.ndarray:
        noise = np.packbits(rng.random((400, 256)) < 0.08, axis=1)
        return looks[rng.integers(0, len(looks), 400)] ^ noise

    database = PlaceDatabase(len(vocabulary))
    print("keyframes   words ms  query ms  insert ms   (400 points each, median of 30)")
    for size in sizes:
        while len(database) < size - 30:
            database.add(len(database), vocabulary.bag(keyframe()))
        times = np.zeros((30, 3))
        for n in range(30):
            descriptors = keyframe()
            stamps = [time.perf_counter()]
            bag = vocabulary.bag(descriptors)
            stamps.append(time.perf_counter())
            np.argsort(-database.scores(bag))
            stamps.append(time.perf_counter())
            database.add(len(database), bag)
            stamps.append(time.perf_counter())
            times[n] = 1e3 * np.diff(stamps)
        print(f"{size:9d}   {'  '.join(f'{t:8.3f}' for t in np.median(times, axis=0))}")


def returns(sequence: SparseSequence) -> set[int]:
    """Keyframes that revisit a place."""
    out: set[int] = set()
    for k in range(GAP, len(sequence.world_T_kf)):
        relative = se3.inverse(sequence.world_T_kf[: k - GAP + 1]) @ sequence.world_T_kf[k]
        turned = np.rad2deg(np.linalg.norm(se3.log(relative)[:, 3:], axis=1))
        if ((np.linalg.norm(relative[:, :3, 3], axis=1) < NEAR_METRES) & (turned < NEAR_DEGREES)).any():
            out.add(k)
    return out


def judge(sequence: SparseSequence, results: list[LoopResult], count: Count) -> None:
    """Add one sequence's accepted loops."""
    again = returns(sequence)
    found = False
    for r in results:
        if r.candidate_kf_id < 0:
            continue
        true = se3.inverse(sequence.world_T_kf[r.candidate_kf_id]) @ sequence.world_T_kf[r.kf_id]
        error = se3.inverse(true) @ r.candidate_T_kf
        metres = float(np.linalg.norm(error[:3, 3]))
        wrong = metres > FALSE_METRES or np.rad2deg(np.linalg.norm(se3.log(error)[3:])) > FALSE_DEGREES
        count.accepted += 1
        count.false += wrong
        count.worst_m = max(count.worst_m, metres)
        if not wrong:
            count.errors.append(metres)
            found |= r.kf_id in again
    count.sequences_with_return += bool(again)
    count.sequences_found += bool(again) and found


def words_alone(sequence: SparseSequence, vocabulary: Vocabulary, config: LoopConfig) -> list[LoopResult]:
    """For every keyframe the earlier one with the best score, with the identity as relative pose."""
    everything = dataclasses.replace(
        config, min_match_fraction=0.0, min_inliers=10**6, max_candidates=1, pause=0, enabled=True
    )
    closer = LoopCloser(everything, sequence.rig, vocabulary)
    out: list[LoopResult] = []
    for keyframe in sequence.keyframes:
        result = closer.step(keyframe)
        if result.rejected:
            candidate, score, _ = result.rejected[0]
            result = dataclasses.replace(result, candidate_kf_id=candidate, score=score, reason="")
        out.append(result)
    return out


WAYS = {
    "words and geometry": LoopConfig(gate_m=1e3, gate_deg=360.0, consistent=1, proximity=False),
    "all": LoopConfig(),
    "all, paper's rules": LoopConfig(reference="best", min_match_fraction=0.3, proximity=False),
}


def identical_aisles(spec: str, seeds: int, vocabulary: Vocabulary, cache: Path | None) -> int:
    """The table, after every sequence; returns the number of false loops of the whole closer."""
    counts = {name: Count() for name in ("words alone", *WAYS)}
    reasons: Counter[str] = Counter()
    for seed in range(seeds):
        begin = time.perf_counter()
        sequence = _sequence(f"{spec}{'&' if '?' in spec else '?'}seed={seed}&walk={seed}", cache)
        judge(sequence, words_alone(sequence, vocabulary, LoopConfig()), counts["words alone"])
        for name, config in WAYS.items():
            closer = LoopCloser(config, sequence.rig, vocabulary)
            results = [closer.step(k) for k in sequence.keyframes]
            judge(sequence, results, counts[name])
            if name == "all":
                reasons.update(reason for r in results for _, _, reason in r.rejected)
        seconds = time.perf_counter() - begin
        print(f"\n{spec}, {seed + 1} sequences (the last: {len(sequence.keyframes)} keyframes, {seconds:.0f} s)")
        print("                       accepted  false  precision  sequences found  median mm  worst m")
        for name, count in counts.items():
            print(count.row(name))
        print("rejected by all: " + ", ".join(f"{n} {r}" for r, n in sorted(reasons.items())), flush=True)
    return counts["all"].false


def cut_sequences(spec: str, seeds: int, vocabulary: Vocabulary, cache: Path | None) -> None:
    """One line: how many sequences with a loss of tracking were connected, correctly or wrongly."""
    outcomes: Counter[str] = Counter()
    for seed in range(seeds):
        sequence = _sequence(f"{spec}{'&' if '?' in spec else '?'}seed={seed}&walk={seed}", cache)
        outcomes.update(_joined(sequence, round(share * len(sequence.keyframes)), vocabulary) for share in CUTS)
    gap = f"{LEFT_OUT} keyframes left out"
    print(f"{spec}, cut in two, {gap}: " + ", ".join(f"{outcomes[k]} {k}" for k in ("right", "wrong", "never")))


def _joined(sequence: SparseSequence, cut: int, vocabulary: Vocabulary) -> str:
    """How the submaps before keyframe `cut` and after the gap are connected: "right", "wrong" or "never"."""
    closer = LoopCloser(LoopConfig(), sequence.rig, vocabulary)
    rest = sequence.keyframes[cut + LEFT_OUT :]
    begin = se3.inverse(rest[0].odom_T_cam)
    anew = [dataclasses.replace(k, submap_id=1, odom_T_cam=begin @ k.odom_T_cam) for k in rest]
    for keyframe in [*sequence.keyframes[:cut], *anew]:
        loop = closer.step(keyframe)
        if 0 <= loop.candidate_kf_id < cut <= loop.kf_id:
            count = Count()
            judge(sequence, [loop], count)
            return "wrong" if count.false else "right"
    return "never"


def _sequence(spec: str, cache: Path | None) -> SparseSequence:
    """Render a sequence, or read it as stored by an earlier run."""
    path = cache / f"{hashlib.sha256(spec.encode()).hexdigest()[:12]}.pkl" if cache else None
    if path is not None and path.exists():
        return pickle.loads(path.read_bytes())
    sequence = sequence_keyframes(spec)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(sequence))
    return sequence


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default="sim:identical-aisles")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--cache", type=Path, help="folder that keeps rendered sequences for the next run")
    parser.add_argument("--cut", action="store_true", help="sequences in which tracking is lost once")
    args = parser.parse_args()
    vocabulary = default_vocabulary()
    if args.cut:
        cut_sequences(args.source, args.seeds, vocabulary, args.cache)
        return 0
    query_times(vocabulary)
    false = identical_aisles(args.source, args.seeds, vocabulary, args.cache) if args.seeds else 0
    return 3 if false else 0


if __name__ == "__main__":
    sys.exit(main())
