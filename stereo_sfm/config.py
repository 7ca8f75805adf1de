"""One tree of frozen dataclasses whose defaults work; load, merge, dump. Unknown keys are errors.

Each setting stands with its default, the values that it takes, and one sentence (`stereo_sfm.settings`).
"""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import read_text
from stereo_sfm.settings import explained, merge, number, path, read, switch, walk, word

MAX_LINE, MAX_TEXT = 4096, 1 << 20  # characters of a configuration file
MAX_CORES = 1024  # of a machine

# Names of earlier versions, in files and in the logs of old runs -> the current name.
RENAMED = {
    "mapper.cauchy_sigmas": "mapper.cauchy_medians",  # a sigma is about two medians
    "tracker.max_error": "tracker.max_error_sigmas",
    "manhattan.model_deg": "manhattan.model_sigma_deg",
    "manhattan.drift_deg_per_frame": "manhattan.drift_sigma_deg_per_frame",
    "mapper.huber": "mapper.huber_sigmas",
    "mapper.max_error": "mapper.max_error_sigmas",
    "mapper.match_distance": "mapper.match_distance_bits",
    "loop.max_distance": "loop.max_distance_bits",
    "loop.pixel_sigma": "loop.sigma_px",
    "loop.gate_metres": "loop.gate_m",
    "loop.gate_degrees": "loop.gate_deg",
}

# Settings of earlier versions that decide nothing any more -> what does.
REMOVED = {
    "tracker.max_window_disparity_px": "the noise of the windows decides",
    "tracker.max_window_difference_sigmas": "it is 1.5",
    "tracker.max_window_sigmas": "it is 1.8",
    "tracker.max_surface_misfit": "it is eight times the typical one",
    "tracker.depth_sigma_px": "it is ten times tracker.sigma_px",
    "features.motion_window_deg": "matches may move by any angle",
    "odometry.unit_step_m": "a step of unknown length is one metre long",
    "odometry.keyframe_rescue_inliers": "it is three quarters of odometry.keyframe_min_inliers",
    "odometry.init_epipolar_px": "it is twice odometry.epipolar_px",
    "odometry.init_parallax_deg": "it is one degree",
    "manhattan.settle_frames": "there are ten",
    "manhattan.gate_deg": "it is twenty times manhattan.model_sigma_deg",
    "mapper.disparity_sigmas": "it is twice mapper.huber_sigmas",
    "mapper.rounds": "there are two",
    "mapper.match_min": "it is four fifths of mapper.connected_points",
    "mapper.match_sigma_px": "it is 2.5 times mapper.sigma_px",
    "mapper.near_keyframes": "there are as many as two views keep",
    "mapper.near_depths": "it is twice what keyframes of one view are apart",
    "mapper.min_observations": "a point needs two keyframes",
    "mapper.crowd_keyframes": "a view keeps five keyframes",
    "mapper.repeated_keyframes": "300 keyframes of earlier visits are kept besides",
    "loop.grow_every": "the vocabulary does not change while it is used",
    "loop.connected_points": "it is half of loop.min_inliers",
    "loop.side_inliers": "it is 1.5 times loop.min_inliers",
    "loop.side_cells": "it is three quarters of loop.min_cells",
    "loop.relocalize_candidates": "there are 16",
    "loop.relocalize_keyframes": "there are six",
    "loop.relocalize_cells": "it is three quarters of loop.min_cells",
    "loop.disparity_sigma": "it is half of loop.sigma_px",
    "loop.disparity_sigma_px": "it is half of loop.sigma_px",
    "loop.ransac_iterations": "there are 400",
    "loop.consistent_window": "it is twice loop.consistent",
    "loop.unknown_way_share": "it is twice loop.min_inlier_share",
    "loop.min_inlier_share_after_gap": "it is twice loop.min_inlier_share",
    "loop.gate_per_metre": "loop.gate_m doubles in 30 m",
    "loop.gate_m_per_m": "loop.gate_m doubles in 30 m",
    "loop.gate_degrees_per_metre": "loop.gate_deg doubles in 10 m",
    "loop.gate_deg_per_m": "loop.gate_deg doubles in 10 m",
}


def estimator_names() -> tuple[str, ...]:
    """The motion estimators other than `flow`: one file each in papers/odometry/."""
    folder = Path(__file__).parent / "papers" / "odometry"
    return tuple(sorted(path.stem.replace("_", "-") for path in folder.glob("[a-z]*.py")))


@dataclass(frozen=True)
class TrackerConfig:
    """The default tracker (tracking/flow/)."""

    max_features: int = number(420, 1, 20_000, "Points followed at once")
    min_features: int = number(15, 3, 10_000, "Inliers below which a frame is lost")
    pyramid_levels: int = number(4, 2, 10, "Levels of the image pyramid, each half as large")
    min_contrast: float = number(
        2.0, 0, 255, "Standard deviation of the grey levels of a window below which it is not used"
    )
    min_ncc: float = number(0.6, -1, 1, "Correlation with the window in the previous frame below which a track ends")
    min_anchor_ncc: float = number(0.85, -1, 1, "The same with the point's first appearance, affinely deformed")
    max_angle_deg: float = number(88.0, 1, 180, "Angle from the optical axis beyond which an image is not used")
    corner_quality: float = number(0.005, 0, 1, "Least corner response, as a share of the strong ones in the image")
    min_depth_baselines: float = number(4.0, 0.1, 1000, "Nearest stereo match that is searched, in baselines")
    sigma_px: float = number(0.3, 0.001, 100, "Noise of one coordinate of an observation at the start of a run")
    max_error_sigmas: float = number(3.0, 0.1, 1000, "Residual above which an observation is an outlier")
    max_epipolar_px: float = number(
        1.0,
        0.01,
        100,
        "Distance of a stereo match from its epipolar curve, before the sequence has shown its own scatter",
    )
    keyframe_share: float = number(0.75, 0, 1, "New keyframe when a smaller share of the last one's points is left")
    keyframe_max_frames: int = number(30, 1, 100_000, "Frames that a keyframe represents at most")
    inertial: bool = switch(
        True, "Use the IMU, if the source has one, to predict poses and to bridge images that show nothing"
    )
    wheels: bool = switch(True, "Use the wheel odometry, if the source has one, in the same way")
    calibrate_sensors: bool = switch(
        False,
        "Estimate time offset and rotation of the IMU, and radii, track and pose of the wheels, while driving",
    )
    lost_s: float = number(
        1.0, 0.0, 1e5, "Seconds without a pose after which a new submap begins, whichever the tracker"
    )

    @property
    def depth_sigma_px(self) -> float:
        """Noise of an observation that refines a depth: as if a hundred successive frames showed the same error."""
        return 10.0 * self.sigma_px


@dataclass(frozen=True)
class FeaturesConfig:
    """Descriptors and matching of the selectable trackers (papers/)."""

    kind: str = word("sift", ("orb", "sift", "akaze"), "Detector and descriptor")
    count: int = number(
        0, 0, 100_000, "Largest number of keypoints per image; 0: OpenCV's default (ORB 500, others no limit)"
    )
    ratio: float = number(0.8, 0.01, 1, "Lowe's ratio: best distance below this share of the second best")
    mask_radius_px: float = number(
        0.0, 0, 100_000, "Keypoints only this near to the last keyframe's stereo points; 0: everywhere"
    )
    stereo_check: str = word("rig", ("rig", "ransac"), "Epipolar check of left-right matches: calibrated or estimated")
    epipolar_px: float = number(1.5, 0.01, 1000, "Largest distance to the epipolar line, in pixels at the image centre")
    stereo_only: bool = switch(True, "With two cameras, use only points seen by both (as the thesis)")
    motion_check: bool = switch(False, "Fundamental RANSAC on matches between frames before the estimator's own")


@dataclass(frozen=True)
class OdometryConfig:
    """Which motion estimator, and its policy (papers/odometry/); "flow" is the default tracker."""

    method: str = word("flow", ("flow", *estimator_names()), "Motion estimator")
    reference: str = word(
        "frame", ("frame", "keyframe"), "Motion is estimated from the previous frame or the last keyframe"
    )
    refine: bool = switch(True, "Least squares over all inliers after the minimal solver")
    weighted: bool = switch(True, "Weigh 3D points by their stereo uncertainty; false: plain means, as the papers")
    epipolar_px: float = number(1.0, 0.01, 1000, "Inlier of an essential matrix, in pixels at the image centre")
    inlier_m: float = number(0.05, 0, 1000, "Inlier of 3D-3D estimators at any depth")
    inlier_sigmas: float = number(
        3.0, 0, 1000, "Standard deviations of the stereo depth added to inlier_m; 0: a fixed threshold"
    )
    max_samples: int = number(512, 1, 1_000_000, "RANSAC hypotheses")
    min_inliers: int = number(8, 1, 100_000, "Inliers below which a frame is lost")
    scale: str = word("stereo", ("stereo", "unit", "ground-truth"), "Scale of translations without metric points")
    keyframe_ratio: float = number(0.3, 0, 1, "New keyframe when a smaller share of the last one's points is tracked")
    keyframe_frames: int = number(30, 0, 100_000, "Frames that a keyframe represents at most; 0: no limit")
    keyframe_min_frames: int = number(0, 0, 100_000, "Frames that a keyframe represents at least")
    keyframe_min_inliers: int = number(
        0, 0, 100_000, "New keyframe below this many inliers, at once below three quarters; 0: the ratio decides"
    )
    monocular: bool = switch(False, "Use the left camera alone, whatever the source has (pnp)")
    init_share: float = number(0.9, 0, 1, "Monocular start: share of the matches that must fit the essential matrix")

    @property
    def keyframe_rescue_inliers(self) -> int:
        """New keyframe at once below this many inliers: tracking would end before `keyframe_min_frames` do."""
        return 3 * self.keyframe_min_inliers // 4


@dataclass(frozen=True)
class ManhattanConfig:
    """Rotation prior from the three dominant directions of the building (tracking/flow/)."""

    enabled: bool = switch(False, "Correct the odometry's rotation by the building's three directions")
    every: int = number(
        15, 1, 10_000_000, "Frames between measurements; one costs as much time as tracking several frames"
    )
    model_sigma_deg: float = number(
        0.15, 1e-6, 90, "Standard deviation of the building's edges from the three directions"
    )
    drift_sigma_deg_per_frame: float = number(
        0.01, 0, 90, "The tracker's rotation error in one frame; it grows with the root of the frames"
    )

    @property
    def gate_deg(self) -> float:
        """Distance from the prediction above which a measurement is refused: another building, not another edge."""
        return 20.0 * self.model_sigma_deg


@dataclass(frozen=True)
class MapperConfig:
    """Local mapping (mapping/mapper.py)."""

    enabled: bool = switch(True, "Build and optimize a map; false: odometry alone")
    window_keyframes: int = number(
        12, 0, 10_000, "Keyframes optimized by local bundle adjustment, the new one included; 0: all connected"
    )
    fixed_keyframes: int = number(
        28, 0, 10_000, "Older keyframes that hold those in place, the ones that share most points with them; 0: all"
    )
    connected_points: int = number(15, 1, 100_000, "Shared points that make two keyframes neighbours")
    sigma_px: float = number(0.4, 0.001, 100, "Noise of one coordinate of a tracked point")
    huber_sigmas: float = number(
        0.75, 0, 1000, "Residual where the loss becomes linear; small because depths at edges are biased"
    )
    cauchy_medians: float = number(
        0.58, 0, 1000, "Scale of the redescending loss in rounds after the first, in median residuals; 0: none"
    )
    sensors: bool = switch(True, "Local bundle adjustment uses what IMU and wheels measured between keyframes")
    iterations: int = number(5, 1, 1000, "Iterations of a round")
    association: str = word(
        "map",
        ("map", "tracks", "previous"),
        "Points are joined by tracks and by descriptors in the map, by tracks only, or with the previous keyframe",
    )
    match_radius_px: float = number(10.0, 0, 10_000, "Search radius around the predicted pixel, in both images")
    match_distance_bits: int = number(50, 0, 256, "Largest distance of descriptors")
    match_ratio: float = number(0.85, 0.01, 1, "Best distance below this share of the second best")
    max_error_sigmas: float = number(3.0, 0, 1000, "Mean error of a point's observations above which it is culled")
    min_parallax_deg: float = number(0.1, 0, 90, "Largest angle between a point's rays below which it is too uncertain")
    redundant_share: float = number(
        0.9, 0, 10, "A keyframe is removed when three others see this share of its points; above 1: never"
    )
    full_ba_growth: float = number(1.15, 1, 1e6, "Full bundle adjustment when the map has grown by this factor")
    full_ba_lag_keyframes: int = number(
        5, 1, 10_000, "Keyframes until its result is applied (in large maps a tenth of their keyframes)"
    )
    final_iterations: int = number(
        60, 0, 10_000, "Iterations of a round of the full bundle adjustment at the end of a run; 0: none"
    )

    @property
    def disparity_sigmas(self) -> float:
        """Mean error of a point's stereo matches beyond which they count less (depth edges); 0: never."""
        return 2.0 * self.huber_sigmas

    @property
    def match_min(self) -> int:
        """Consistent matches below which none is used: a few points fewer than connect two keyframes."""
        return 4 * self.connected_points // 5

    @property
    def match_sigma_px(self) -> float:
        """Noise of one coordinate of a point found again by its descriptor: two tracks agree less well than one."""
        return 2.5 * self.sigma_px

    @property
    def most_keyframes(self) -> int | None:
        """`window_keyframes` as the end of a slice: None takes all."""
        return self.window_keyframes if self.window_keyframes > 0 else None

    @property
    def most_fixed(self) -> int | None:
        """`fixed_keyframes` as the end of a slice: None takes all."""
        return self.fixed_keyframes if self.fixed_keyframes > 0 else None


@dataclass(frozen=True)
class LoopConfig:
    """Loop closing (loop/closer.py), and finding the camera in a saved map."""

    enabled: bool = switch(True, "Search for loops")
    correction: str = word(
        "pose_graph", ("pose_graph", "averaging"), "How the loop's error is spread over the keyframes"
    )
    robust: str = word("gnc", ("gnc", "switchable", "none"), "How the pose graph withstands a false loop")
    vocabulary: str = path("Vocabulary file; empty: the one in the package")
    score_ratio: float = number(0.9, 0, 10, "Candidates must score above this share of the connected keyframes' score")
    reference: str = word(
        "weakest", ("weakest", "best"), "Which of the connected keyframes' scores (weakest finds more; paper: best)"
    )
    min_score: float = number(0.02, 0, 1, "Score below which no candidate is considered")
    min_gap: int = number(10, 0, 1_000_000, "Keyframes between a keyframe and its candidate")
    max_candidates: int = number(3, 1, 1000, "Places verified for a keyframe")
    corners: int = number(
        400, 1, 20_000, "Corners for recognising a keyframe, since tracked points are seldom detected again"
    )
    side_corners: int = number(
        600, 0, 20_000, "Corners in views that face the shelves, to recognise a place in both directions; 0: none"
    )
    proximity: bool = switch(True, "Verify also the old keyframe that should be nearest by odometry")
    pause: int = number(10, 0, 1_000_000, "Keyframes after an accepted loop without a search for another")
    min_match_fraction: float = number(0.15, 0, 1, "Share of the keyframe's corners that must match (paper: 0.3)")
    max_distance_bits: int = number(60, 0, 256, "Largest distance of matching descriptors")
    match_ratio: float = number(0.9, 0.01, 1, "Nearest distance below this share of the second nearest")
    sigma_px: float = number(1.0, 0.001, 100, "Noise of a point found again from another viewpoint")
    min_inliers: int = number(30, 1, 1_000_000, "Inliers below which a loop is rejected")
    min_inlier_share: float = number(0.15, 0, 1, "The same as a share of the keyframe's corners")
    min_cells: int = number(8, 0, 48, "Cells of a grid of 8 x 6 over the image that must contain inliers")
    consistent: int = number(2, 1, 1000, "Keyframes, among twice as many, that must agree on a loop")
    gate_m: float = number(0.3, 0, 1e6, "Distance by which a loop may contradict odometry; it doubles in 30 m")
    gate_deg: float = number(3.0, 0, 360, "Angle by which a loop may contradict odometry; it doubles in 10 m")
    relocalize_inliers: int = number(56, 1, 100_000, "Corners that must agree with the pose found in a saved map")
    relocalize_share: float = number(
        0.25, 0, 1, "The same as a share of the camera's corners (near a guess: min_inlier_share)"
    )
    seed: int = number(0, 0, 10**9, "Seed of the RANSAC samples of the verification")

    @property
    def connected_points(self) -> int:
        """Shared points that make two keyframes connected: half of what makes a loop."""
        return self.min_inliers // 2

    @property
    def side_inliers(self) -> int:
        """Corners of views that face the shelves that must agree for a loop across directions: products repeat."""
        return 3 * self.min_inliers // 2

    @property
    def fewer_cells(self) -> int:
        """Cells of the image that must contain inliers where only a part of it can: of a side view, of a saved map."""
        return 3 * self.min_cells // 4

    @property
    def disparity_sigma_px(self) -> float:
        """Noise of a stereo point's disparity: both images are of one viewpoint."""
        return 0.5 * self.sigma_px

    @property
    def consistent_window(self) -> int:
        """Newest keyframes among which `consistent` ones must agree on a loop."""
        return 2 * self.consistent

    @property
    def min_inlier_share_after_gap(self) -> float:
        """Share of inliers required after a loss of tracking, where odometry cannot confirm the loop."""
        return 2.0 * self.min_inlier_share

    def gate(self, metres: float = 0.0) -> tuple[float, float]:
        """Metres and radians by which odometry over so many metres may err: a percent of them, and at first more."""
        return self.gate_m * (1.0 + metres / 30.0), math.radians(self.gate_deg) * (1.0 + metres / 10.0)


@dataclass(frozen=True)
class SelfCalibrationConfig:
    """Whether the rotation of the right camera and its like are corrected from what is seen."""

    mode: str = word("auto", ("auto", "off", "only-report"), "Correct the rig from what is seen, or only report it")


@dataclass(frozen=True)
class DenseConfig:
    """Depth images and obstacles of the newest pair, while a run goes on (dense/live.py)."""

    live: bool = switch(False, "Compute depth images and obstacles in a process of their own, which delays no pose")
    rate_hz: float = number(5.0, 0.01, 1000, "Depth images a second; a slow computer makes fewer")
    scale: float = number(0.5, 0.05, 1, "Resolution of the depth images over that of the camera's")
    range_m: float = number(5.0, 0.1, 1000, "Obstacles that are farther away are left out")
    min_height_m: float = number(0.1, 0, 100, "Height above the floor below which nothing is an obstacle")
    max_height_m: float = number(2.0, 0, 100, "Height above the floor above which nothing is an obstacle")
    camera_height_m: float = number(
        0.0, 0, 100, "Height of the left camera above the floor; 0: that of the calibration's body, else as seen"
    )


STAGES = ("capture", "tracker", "mapper", "loop", "optimizer", "dense", "logger", "viewer")  # processes of a run


@dataclass(frozen=True)
class PipelineConfig:
    """Connections between the stages (pipeline/)."""

    update_lag_frames: int = number(
        5, 1, 10_000, "Frames between a keyframe and the frame before which its map update is applied"
    )
    loop_lag_keyframes: int = number(2, 0, 10_000, "Keyframes after which the loop of a keyframe reaches the mapper")
    ring_slots: int = number(8, 1, 1024, "Image pairs in shared memory between capture and the stages")
    threads: int = number(1, 1, 256, "Threads of OpenCV and BLAS in each process")
    cpus: dict[str, tuple[int, ...]] = field(
        default_factory=dict[str, tuple[int, ...]],
        metadata={"text": f"Cores that a stage may use, as tracker = [0, 1]; stages: {', '.join(STAGES)}"},
    )


@dataclass(frozen=True)
class Config:
    """Everything that decides what a run computes. The resolved tree is saved with every run."""

    seed: int = number(0, 0, 10**9, "Seed of the estimators of --odometry")
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    manhattan: ManhattanConfig = field(default_factory=ManhattanConfig)
    mapper: MapperConfig = field(default_factory=MapperConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    self_calibration: SelfCalibrationConfig = field(default_factory=SelfCalibrationConfig)
    dense: DenseConfig = field(default_factory=DenseConfig)
    pipeline: PipelineConfig = field(default_factory=PipelineConfig)

    def closes_loops(self, depth: bool, localize_only: bool) -> bool:
        """Whether a run searches for loops: it maps, and has depth (from two cameras or a depth image)."""
        return self.loop.enabled and self.mapper.enabled and depth and not localize_only


def renamed(data: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Nested values under current names, and the old names that were found."""
    out, met = dict(data), list[str]()
    for old, new in RENAMED.items():
        (section, old_key), new_key = old.split("."), new.split(".")[1]
        inside = out.get(section)
        if isinstance(inside, dict) and old_key in inside:
            moved: dict[str, Any] = dict(inside)  # pyright: ignore[reportUnknownArgumentType]
            moved.setdefault(new_key, moved[old_key])
            del moved[old_key]
            out[section] = moved
            met.append(old)
    for old in REMOVED:
        section, key = old.split(".")
        inside = out.get(section)
        if isinstance(inside, dict) and key in inside:
            out[section] = {k: v for k, v in inside.items() if k != key}  # pyright: ignore[reportUnknownVariableType]
            met.append(old)
    return out, met


def _with_current_names(data: dict[str, Any]) -> dict[str, Any]:
    """One layer of values under current names; logs a warning for each old name."""
    out, met = renamed(data)
    for old in met:
        now = f"is called {RENAMED[old]} now" if old in RENAMED else f"is ignored: {REMOVED[old]}"
        logging.getLogger("stereo_sfm").warning("configuration: %s %s", old, now)
    return out


def from_dict(data: dict[str, Any]) -> Config:
    """Nested plain values over the defaults; names of earlier versions are accepted silently.

    Raises:
        StereoSfmError: an unknown key, a value of the wrong type, or one that its setting does not take.
    """
    data, _ = renamed(data)
    config = read(Config(), data, "stereo-sfm config dump")
    _check_cores(config.pipeline.cpus)
    return config


def _check_cores(cpus: dict[str, tuple[int, ...]]) -> None:
    unknown = sorted(set(cpus) - set(STAGES))
    if unknown:
        raise StereoSfmError(f"configuration: pipeline.cpus names '{unknown[0]}': the stages are {', '.join(STAGES)}")
    wrong = [core for cores in cpus.values() for core in cores if not 0 <= core < MAX_CORES]
    if wrong:
        raise StereoSfmError(f"configuration: pipeline.cpus names core {wrong[0]}: cores are 0 to {MAX_CORES - 1}")


def load(path: Path | str | None = None, overrides: Iterable[str] = (), base: dict[str, Any] | None = None) -> Config:
    """Defaults, `base`, a TOML file, then `key.subkey=value` overrides, values read as TOML (else as text)."""
    data: dict[str, Any] = _with_current_names(base or {})
    if path is not None:
        data = merge(data, _with_current_names(read_toml(Path(path).expanduser())))
    for override in overrides:
        data = merge(data, _with_current_names(parse_override(override, Config())))
    return from_dict(data)


def parse_toml(text: str) -> dict[str, Any]:
    """Nested values.

    Raises:
        ValueError: not TOML, too long, or nested too deeply.
    """
    if max(map(len, text.splitlines()), default=0) > MAX_LINE or len(text) > MAX_TEXT:
        raise ValueError("it is too long for a configuration")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def read_toml(path: Path, see: str = "stereo-sfm config dump") -> dict[str, Any]:
    """The nested values of a configuration file. Args: see, the command that prints one.

    Raises:
        StereoSfmError: it cannot be read, or is not TOML.
    """
    try:
        return parse_toml(read_text(path, MAX_TEXT))
    except FileNotFoundError:
        raise StereoSfmError(f"no configuration file at {path} ('{see}' prints one)") from None
    except OSError as error:
        raise StereoSfmError(f"cannot read the configuration {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise StereoSfmError(f"configuration {path}: it is not a text file (expected TOML)") from None
    except ValueError as error:
        raise StereoSfmError(f"configuration {path}: {error}") from None


def parse_override(override: str, tree: Any) -> dict[str, Any]:
    """`key.subkey=value` as nested values, where a setting of `tree` that is a text takes the value as it is."""
    key, equals, value = override.partition("=")
    if not equals:
        raise StereoSfmError(f"--set takes key=value, as tracker.max_features=600, not '{override}'")
    quoted = json.dumps(value, ensure_ascii=False)  # a string of JSON is one of TOML
    is_text = any(name == key.strip() and isinstance(old, str) for name, _, old in walk(tree))
    for text in (value, quoted) if not is_text or value.strip()[:1] in ("'", '"') else (quoted,):
        try:
            return parse_toml(f"{key} = {text}")
        except ValueError:
            continue
    raise StereoSfmError(f"--set cannot read '{override[:80]}': write it as in tracker.max_features=600")


def dump(config: Config) -> str:
    """The whole tree as TOML that `load` reads back."""
    import tomli_w

    return tomli_w.dumps(dataclasses.asdict(config))


def explain(config: Config) -> str:
    """As `dump`, with the description of every setting as a comment above it."""
    return explained(config)
