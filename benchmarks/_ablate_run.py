"""The runs of one variant of `benchmarks ablate`, in a process of its own: a line of JSON for each part of a sequence.

python _ablate_run.py SOURCE START_S DURATION_S [RIG] -- SOURCE ...
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import sys
import time
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import stereo_sfm.same_code

assert stereo_sfm.same_code  # before numpy: it chooses the machine code

import cv2
import numpy as np

from stereo_sfm import config as configuration
from stereo_sfm.drivers.choice import SourceChoice
from stereo_sfm.drivers.select import SelectedFrames
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.eval.evaluate import evaluate
from stereo_sfm.eval.record import RunRecord
from stereo_sfm.pipeline.run import run


def measure(source: str, start_s: float, duration_s: float, rig: str) -> dict[str, Any]:
    """Errors, losses and a fingerprint of a part of a sequence, run in this process."""
    config = configuration.load(None, [])
    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    begin = time.process_time()
    opened = SourceChoice.of(source, rig or None)()
    with SelectedFrames(opened, start_s=start_s, duration_s=duration_s or float("inf")) as frames:
        record = RunRecord.of(config)
        for _ in run(frames, config, [record]):
            pass
        truth = frames.ground_truth
    tracked = record.tracked()
    estimate, odometry = record.mapped(), record.odometry()
    assert estimate is not None and odometry is not None  # inline, with a map
    out: dict[str, Any] = {
        "frames": len(tracked),
        "lost": int(np.count_nonzero(~tracked)),
        "corrections": sum(c.applied and c.why != "step" for c in record.calibrations),
        "steps": sum(c.applied and c.why == "step" for c in record.calibrations),
        "seconds": round(time.process_time() - begin, 2),
        "bits": hashlib.sha256(odometry.poses.tobytes() + estimate.poses.tobytes()).hexdigest()[:12],
    }
    for name, trajectory in (("map_m", estimate), ("odometry_m", odometry)):
        try:
            out[name] = evaluate(trajectory, truth).ape_m.rmse if truth is not None else None
        except StereoSfmError:
            out[name] = None
    if truth is None and len(estimate.poses):  # the way back to the first place
        out["map_m"] = float(np.linalg.norm(estimate.poses[-1][:3, 3] - estimate.poses[0][:3, 3]))
    return out


def main(args: list[str]) -> int:
    """Measure each part."""
    for is_end, part in itertools.groupby(args, lambda a: a == "--"):
        if not is_end:
            source, start_s, duration_s, *rig = part
            print(json.dumps(measure(source, float(start_s), float(duration_s), rig[0] if rig else "")), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
