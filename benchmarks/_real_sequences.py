"""The real sequences of `benchmarks real`: where they lie, their starts, what must hold, and what others reach."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path

from _sequences import data_root

FOLDER = "STEREO_SFM_REAL"  # environment variable: the sequences that are laid out from public repositories
# What `benchmarks changed` makes of pairs:
CHANGED = "backwards", "mirrored", "upside down", "half the rate", "half the size"
BONN_STARTS_S = (0.0, 1.0, 2.0, 7.0, 7.8, 9.0, 10.0, 12.0, 14.0, 15.5, 16.0, 16.5, 18.0, 20.0, 22.0, 23.0)


@dataclass(frozen=True)
class Limits:
    """What a default run must reach; None: nothing is asked."""

    ate_m: float | None = None  # after SE(3) alignment, of every start
    median_ate_m: float | None = None  # over the starts
    uncalibrated_ate_m: float | None = None  # of every start, with self-calibration off; then none is lost either
    lost: int | None = 0  # frames without a pose, of every start
    lost_share: float | None = None  # the same over all starts together, instead of `lost`
    loops: int = 0
    angle_error_deg: float | None = None
    like: tuple[str, float] | None = None  # ATE at most so many times that of another sequence, same start
    moves_more: bool = False  # than a camera that stands still: its ATE is larger
    steps: int = 0  # false ones


@dataclass(frozen=True)
class Sequence:
    """One sequence and the parts of it that are run."""

    name: str
    place: str  # in its folder
    limits: Limits = field(default_factory=Limits)
    rate_hz: float = 10.0  # of the images, for starts some frames later
    starts: int = 5  # a frame apart
    starts_s: tuple[float, ...] = ()  # instead, seconds
    duration_s: float = 0.0  # of each; 0: to the end
    shared: bool = False  # in STEREO_SFM_DATA instead of STEREO_SFM_REAL
    rig: str = ""  # calibration beside it
    kind: str = "stereo"  # stereo, depth, inertial
    rest: bool = False  # the camera stands still: the ATE is the RMS of its motion
    deg_per_s: float = 0.0  # a turn of known speed
    long: bool = False  # and of two cameras: enough images before and after a step
    closed: bool = False  # ends about where it starts
    best_cpp: str = ""  # of the C++ systems, ATE
    changed: str = ""  # one of CHANGED: of another sequence

    def path(self, real: Path | None) -> Path | None:
        """Where it lies; None if it is not at hand."""
        root = data_root() if self.shared else real
        return root / self.place if root is not None and (root / self.place).exists() else None

    def begins(self, most: int | None = None) -> list[float]:
        """Seconds after the first frame at which runs begin."""
        frames = [max(k - 0.5, 0.0) / self.rate_hz for k in range(self.starts)]  # half a frame before each
        return [round(s, 4) for s in self.starts_s or frames][:most]


_AS_THEY_ARE = (
    Sequence(
        "karlsruhe_0019", "karlsruhe_0019", Limits(ate_m=1.2, uncalibrated_ate_m=1.9), rate_hz=9.5, best_cpp="1.41 m",
        long=True,
    ),
    Sequence("kitti_extract", "kitti_extract", Limits(ate_m=0.34), long=True),
    Sequence("kitti_01", "kitti/sequences/01", Limits(ate_m=0.12), rate_hz=9.65, best_cpp="0.91 m"),
    Sequence("kitti_06", "kitti/sequences/06", Limits(ate_m=0.06), rate_hz=9.65, best_cpp="0.041 m"),
    Sequence("library_walk", "library_walk", Limits(loops=1), rate_hz=12.0, shared=True, closed=True, long=True),
    Sequence(
        "moon_yard", "moon_yard", Limits(lost=3, like=("moon_yard_fixed", 1.3)), rate_hz=1.0
    ),
    Sequence("moon_yard_fixed", "moon_yard_fixed", Limits(ate_m=0.037, lost=None), rate_hz=1.0, long=True),
    Sequence("medical_rotation", "medical_rotation", Limits(angle_error_deg=0.02), deg_per_s=10.0),
    Sequence(
        "fr1_xyz", "rgbd_dataset_freiburg1_xyz", Limits(ate_m=0.007), rate_hz=30.0, kind="depth"
    ),
    Sequence("zed_conveyor", "zed_conveyor", Limits(ate_m=0.0012), rate_hz=30.0, rest=True, long=True),
    Sequence(
        "bonn_crowd", "rgbd_bonn_crowd", Limits(ate_m=0.018, lost=22), rate_hz=30.0, kind="depth", rig="bonn_rig.yaml",
        best_cpp="1.85 m (pyorbslam3)",
    ),
    Sequence(
        "bonn_crowd_8s", "rgbd_bonn_crowd", Limits(median_ate_m=0.02, lost=None, lost_share=0.05, moves_more=True),
        starts_s=BONN_STARTS_S, duration_s=8.0, kind="depth", rig="bonn_rig.yaml",
    ),
    # Of jmstark/gpu_odometry, Frozenheart1998/PclMapping, MissingLight/Stereo-Vision-SLAM, andyzeng/tsdf-fusion-python
    # (depth registered to colour) and edufschmidt/stereo-vo: first run when everything else was built.
    Sequence("fr1_rpy", "rgbd_dataset_freiburg1_rpy", rate_hz=30.0, kind="depth"),
    Sequence("kitti_06_grey", "kitti_06_grey/sequences/06", rate_hz=9.65),
    Sequence("kitti_06_colour", "kitti_06_colour/sequences/06", rate_hz=9.65),
    Sequence("kitti_raw_0926", "kitti_raw_0926_1310"),
    Sequence("seven_scenes", "seven_scenes", rate_hz=30.0, kind="depth", rig="seven_scenes_rig.yaml"),
    Sequence("backyard", "backyard_bumblebee", rate_hz=12.0),
    # Of SihanWang-WHU/Stereo_VO and BhavyanshM/StereoVisualOdometry, laid out as KITTI; the car drives at each start.
    Sequence("kitti_03", "kitti_03/sequences/03", starts_s=(0.0, 1.0, 2.0, 3.0, 4.8, 5.0, 5.4)),
    Sequence("kitti_00_start", "kitti_00_start/sequences/00", starts_s=(0.0, 1.0, 2.0, 3.0, 5.0)),
    # Of feixyz10/oh_my_vslam (frames 100 to 159), and in the histories of petercorke/RVC3-MATLAB and HustRobot/VSLAM.
    Sequence("kitti_05_part", "kitti_05_part/sequences/05", starts_s=(0.0, 0.1, 0.2, 0.3, 0.4)),
    Sequence("daimler_bridge", "daimler_bridge", starts_s=(0.0, 1.0, 2.0, 3.0, 5.0)),
    Sequence("fr1_desk", "rgbd_dataset_freiburg1_desk", starts_s=(0.0, 2.0, 4.0, 6.0, 8.0), kind="depth"),
    # Of iamliguangming/MEAM620 (MachineHall01_reduced) and MIT-SPARK/Kimera-VIO (MicroEurocDataset), laid out as EuRoC.
    Sequence("euroc_mh01_30s", "euroc_mh01_30s", rate_hz=20.0, starts_s=(0.0, 1.0, 2.0, 3.0, 5.0), long=True),
    Sequence("euroc_v101_start", "euroc_v101_start", rate_hz=20.0, kind="inertial", rest=True),
    Sequence("karlsruhe_part", "karlsruhe_part", rate_hz=9.5, shared=True),
    Sequence("kitti_00_part", "kitti", rate_hz=9.65, shared=True, best_cpp="0.319 m", long=True),
    Sequence("euroc_mh01_part", "euroc_mh01", rate_hz=20.0, shared=True, kind="inertial", best_cpp="4.6 mm", long=True),
    Sequence("fr1_xyz_part", "rgbd_dataset_freiburg1_xyz", rate_hz=7.5, shared=True, kind="depth"),
    Sequence("store_walk", "store_walk", rate_hz=15.0, shared=True, long=True),
    Sequence("tum_vi_room1_part", "tum_vi_room1", rate_hz=20.0, starts=1, shared=True),
    Sequence("t265_office_part", "t265_office", rate_hz=30.0, starts=1, shared=True),
)  # fmt: skip

SEQUENCES = _AS_THEY_ARE + tuple(
    replace(
        s, name=f"{s.name} {how}", place=f"changed/{s.name}_{how.replace(' ', '_')}", limits=Limits(lost=s.limits.lost),
        starts=1, shared=False, rig="", kind="stereo", long=False, best_cpp="", changed=how,
    )
    for s in _AS_THEY_ARE
    if s.kind != "depth"
    for how in CHANGED
)  # fmt: skip


def real_root(given: Path | None) -> Path | None:
    """The folder of the laid-out sequences: that given, or STEREO_SFM_REAL."""
    named = given or (Path(os.environ[FOLDER]) if os.environ.get(FOLDER) else None)
    return named if named is not None and named.is_dir() else None
