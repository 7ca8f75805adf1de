"""The real sequences, and the errors of other systems on them."""

from __future__ import annotations

import os
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

FOLDERS = ("kitti", "euroc_mh01", "tum_vi_room1", "t265_office", "rgbd_dataset_freiburg1_xyz")
SIMULATED = ("sim:loop",)
# Cameras as they are in the world: lenses that differ from their calibration, unequal ones, few and coarse pixels,
# slow ones, stamps that are not true.
IMPERFECT = tuple(
    f"sim:loop?{options}"
    for options in (
        "rate=15&frames=300",  # for comparison
        "rate=15&frames=300&residual=0.5",
        "camera=pinhole&rate=15&frames=300&rows=0.5",
        "camera=distorted&rate=15&frames=300&decentered=0.5&tilted=0.5",
        "rate=15&frames=300&right_exposure=0.6&right_blur=1",
        "camera=pinhole&size=320x240&rate=12&frames=240&jpeg=25&rows=0.5",
        "rate=2&frames=80",
        "rate=1&frames=40&speed=0.5",
        "rate=10&frames=200&stamped=30&stamp_jitter_ms=5",
    )
)

# ATE in metres after SE(3) alignment and, in the second place, after Sim(3) alignment, of the C++ systems with their
# bundle adjustment and loop closing, measured with the same parts of the sequences.
PEERS: dict[str, dict[str, tuple[float, float]]] = {
    "kitti": {"ORB-SLAM3": (0.449, 0.198), "OV²SLAM": (0.338, 0.198), "basalt": (0.319, 0.193)},
    "euroc_mh01": {"ORB-SLAM3": (0.0046, 0.0043), "OV²SLAM": (0.0047, 0.0045), "basalt": (0.0046, 0.0044)},
}


def one_thread() -> None:
    """Before numpy and OpenCV are imported: limit every library to one thread."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    import cv2

    cv2.setNumThreads(1)


def data_root() -> Path | None:
    """STEREO_SFM_DATA, or ../shared/data beside the checkout."""
    candidates = (os.environ.get("STEREO_SFM_DATA"), ROOT.parent / "shared" / "data")
    return next((Path(c) for c in candidates if c and Path(c).is_dir()), None)


def sequences(named: list[str]) -> list[tuple[str, str]]:
    """(name, source) of the sequences to run on: those named, else all available ones and the simulated ones."""
    root = data_root()
    if named:
        return [(n, str(root / n) if root is not None and n in FOLDERS else n) for n in named]
    if root is None:
        print("no real sequences: set STEREO_SFM_DATA to their folder", file=sys.stderr)
    real = [(name, str(root / name)) for name in FOLDERS if root is not None and (root / name).is_dir()]
    return real + [(name, name) for name in SIMULATED]
