"""One tree of frozen dataclasses whose defaults work; load, merge, dump. Unknown keys are errors."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stereo_sfm.errors import StereoSfmError

MOST = 10**9  # that any whole number of the configuration may be


def one_of(*words: str) -> Any:
    """A field that takes one of these words, the first by default."""
    return field(default=words[0], metadata={"words": words})


def above_zero(default: float) -> Any:
    """A field that must be above 0; all other numbers must be at least 0."""
    return field(default=default, metadata={"above_zero": True})


def within(least: int, most: int, default: int) -> Any:
    """A field that takes whole numbers from `least` to `most`."""
    return field(default=default, metadata={"range": (least, most)})


@dataclass(frozen=True)
class TrackerConfig:
    """The default tracker (tracking/tracker.py)."""

    max_features: int = within(1, 20_000, 400)  # points tracked at once
    min_features: int = within(3, 10_000, 15)  # inliers below which a frame is lost
    pyramid_levels: int = within(2, 10, 4)
    min_contrast: float = 2.0  # grey levels of standard deviation; flatter windows are no points
    min_ncc: float = 0.6  # of a window with the previous frame's
    min_anchor_ncc: float = 0.85  # of a window with the point's first appearance, affinely deformed
    max_angle_deg: float = 88.0  # from the optical axis; beyond it a fisheye image is not used
    corner_quality: float = 0.005  # least corner response, as a share of the strong ones in the image
    min_depth_baselines: float = above_zero(4.0)  # nearest stereo match searched, in baselines
    sigma_px: float = above_zero(0.3)  # noise of one coordinate of an observation, to start with: follows the residuals
    depth_sigma_px: float = above_zero(3.0)  # the same when a depth is refined from frame to frame: errors repeat
    max_error: float = above_zero(3.0)  # sigmas; a worse observation is no inlier
    max_epipolar_px: float = above_zero(1.0)  # distance of a stereo match from its epipolar curve
    max_window_disparity_px: float = 0.15  # a narrow and a wide window must agree on the disparity: no depth edge in it
    keyframe_share: float = 0.75  # new keyframe when fewer of the last keyframe's points are still tracked
    keyframe_max_frames: int = 30
    lost_frames: int = 15  # frames without a pose after which a new submap begins, whichever the tracker


@dataclass(frozen=True)
class FeaturesConfig:
    """Descriptors and matching of the selectable trackers (tracking/features.py, tracking/matching.py)."""

    kind: str = "sift"  # orb | sift | akaze
    count: int = 0  # most keypoints of an image; 0: what OpenCV's own default is (ORB 500, the others no limit)
    ratio: float = above_zero(0.8)  # Lowe's: best distance below this share of the second best
    mask_radius_px: float = 0.0  # keypoints only this near to the last keyframe's stereo points; 0: everywhere
    stereo_check: str = one_of("rig", "ransac")  # epipolar check of left-right matches: calibrated | estimated
    epipolar_px: float = above_zero(1.5)  # largest distance to the epipolar line, in pixels at the image centre
    stereo_only: bool = True  # with two eyes, only points that both see (as the thesis)
    motion_check: bool = False  # fundamental RANSAC on matches between frames too, before the estimator's own
    motion_window_deg: float = 0.0  # drop matches that moved by more than this angle between frames; 0: keep all


@dataclass(frozen=True)
class OdometryConfig:
    """Which motion estimator, and its policy (tracking/odometry/); "flow" is the default tracker."""

    method: str = "flow"  # flow | em-r | vp-r | r-um | um | eight-point | pnp
    reference: str = one_of("frame", "keyframe")  # motion is estimated from the previous frame or the last keyframe
    refine: bool = True  # least squares over all inliers after the minimal solver
    weighted: bool = True  # weigh 3D points by their stereo uncertainty; False: plain means, as the papers
    epipolar_px: float = above_zero(1.0)  # inlier of an essential matrix, in pixels at the image centre
    inlier_m: float = 0.05  # inlier of 3D-3D estimators at any depth, metres
    inlier_sigmas: float = 3.0  # and on top this many standard deviations of the stereo depth; 0: a fixed threshold
    max_samples: int = above_zero(512)  # RANSAC hypotheses
    min_inliers: int = above_zero(8)
    scale: str = one_of("stereo", "unit", "ground-truth")  # of translations without metric points
    unit_step_m: float = above_zero(1.0)  # length of one step with scale "unit"
    keyframe_ratio: float = 0.3  # new keyframe when fewer of the last keyframe's points are tracked
    keyframe_frames: int = 30  # a keyframe represents at most this many frames
    keyframe_min_frames: int = 0  # and at least this many
    keyframe_min_inliers: int = 0  # new keyframe below this number of inliers; 0: the ratio decides
    keyframe_rescue_inliers: int = 0  # below this number at once, whatever the other rules say
    monocular: bool = False  # use the left eye alone, whatever the source has (pnp)
    init_share: float = 0.9  # monocular start: matches that must fit the essential matrix (C++ course system)
    init_epipolar_px: float = 2.0  # monocular start: what counts as fitting
    init_parallax_deg: float = 1.0  # monocular start: least median parallax


@dataclass(frozen=True)
class ManhattanConfig:
    """Rotation prior from the world's three directions (tracking/manhattan_prior.py)."""

    enabled: bool = False
    every: int = above_zero(15)  # frames between measurements: finding the lines costs several frames of tracking
    settle_frames: int = 10  # measurements that must agree before the axes are believed
    gate_deg: float = 3.0  # a measurement further from the prediction is refused
    model_deg: float = above_zero(0.15)  # how exactly the world follows three directions
    drift_deg_per_frame: float = 0.01  # standard deviation of the tracker's rotation, grows with the root of the frames


@dataclass(frozen=True)
class MapperConfig:
    """Local mapping (mapping/mapper.py)."""

    enabled: bool = True
    window_keyframes: int = 12  # keyframes that local bundle adjustment moves, the new one included; 0: all connected
    connected_points: int = 15  # shared points that make two keyframes neighbours
    sigma_px: float = above_zero(0.4)  # noise of one coordinate of a tracked point
    huber: float = 0.75  # sigmas; narrow, for depths near edges err to one side and would bend the scale
    rounds: int = 2  # of bundle adjustment, outliers are judged between them
    iterations: int = 5  # of a round
    # "tracks": identity only; "map": also by descriptors; "previous": the retail paper's rule
    association: str = one_of("map", "tracks", "previous")
    match_radius_px: float = 10.0  # around the predicted pixel, in both eyes
    match_distance: int = 50  # differing bits of 256
    match_ratio: float = 0.85  # best / second best
    match_sigma_px: float = above_zero(1.0)  # noise of one coordinate of a point found again by its descriptor
    match_min: int = 12  # fewer agreeing matches are not believed
    near_keyframes: int = 10  # keyframes standing close by whose points are searched too
    near_depths: float = 0.3  # how close, in median depths of the new keyframe
    min_observations: int = 2  # keyframes below which a point that is no longer tracked is culled
    max_error: float = 3.0  # sigmas; a point whose observations are on average worse is culled
    min_parallax_deg: float = 0.1  # rays, both eyes included, that never were further apart make a point too uncertain
    redundant_share: float = 0.9  # a keyframe goes when so many of its points are seen by three others; above 1: never
    crowd_keyframes: int = 5  # keyframes with the same view that stay
    full_ba_growth: float = 1.15  # full bundle adjustment also when the map has grown by this factor since the last
    full_ba_lag_keyframes: int = 5  # keyframes until its answer is applied (large maps: a tenth of theirs)

    @property
    def most_keyframes(self) -> int | None:
        """`window_keyframes` as the end of a slice: None takes all."""
        return self.window_keyframes if self.window_keyframes > 0 else None


@dataclass(frozen=True)
class LoopConfig:
    """Loop closing (loop/closer.py)."""

    enabled: bool = True
    correction: str = one_of("pose_graph", "averaging")  # how the loop's error is spread over the keyframes
    robust: str = one_of("gnc", "switchable", "none")  # how the pose graph takes loops
    vocabulary: str = ""  # vocabulary file; empty: the one of the package
    grow_every: int = 0  # keyframes between growths of the vocabulary in a new environment; 0: never
    score_ratio: float = 0.9  # candidates score above this times the reference score of the connected keyframes
    reference: str = one_of("weakest", "best")  # reference: their weakest score (finds more) or best (retail paper)
    min_score: float = 0.02  # ... and above this
    connected_points: int = 15  # shared points that make two keyframes connected
    min_gap: int = 10  # keyframes between a keyframe and its candidate
    max_candidates: int = 3  # places verified per keyframe
    corners: int = within(1, 20_000, 400)  # a keyframe is recognised by: tracked points are seldom detected again
    proximity: bool = True  # verify also the old keyframe that should be nearest by odometry
    pause: int = 10  # keyframes after an accepted loop in which none is searched
    min_match_fraction: float = 0.15  # of the keyframe's corners that must match the candidate's (paper: 0.3)
    max_distance: int = 60  # bits between matching descriptors
    match_ratio: float = 0.9  # nearest / second nearest descriptor
    pixel_sigma: float = above_zero(1.0)  # px, of a point found again from another side
    disparity_sigma: float = above_zero(0.5)  # px, of a stereo point's disparity
    ransac_iterations: int = above_zero(400)
    min_inliers: int = above_zero(30)
    min_inlier_share: float = 0.15  # ... and of the keyframe's corners
    min_cells: int = 8  # of the 8 x 6 cells of the image that hold inliers
    consistent: int = 2  # successive keyframes that must agree on a loop
    consistent_window: int = 4  # ... within so many keyframes
    unknown_way_share: float = 0.3  # share of inliers where tracking broke and odometry cannot speak for a loop
    gate_metres: float = 0.3  # a loop may contradict odometry by this much ...
    gate_per_metre: float = 0.01  # ... plus this for every metre walked since
    gate_degrees: float = 3.0
    gate_degrees_per_metre: float = 0.3
    relocalize_candidates: int = 16  # places of a saved map that are verified
    relocalize_keyframes: int = above_zero(6)  # keyframes whose points make up a place
    relocalize_inliers: int = 56  # corners that must agree with the pose found in a saved map
    relocalize_share: float = 0.25  # ... and so large a share of the camera's corners (near a guess: min_inlier_share)
    relocalize_cells: int = 6  # ... in so many of the image's 8 x 6 cells
    seed: int = 0  # of the samples of verification


STAGES = ("capture", "tracker", "mapper", "loop", "optimizer", "logger", "viewer")  # processes of a run


@dataclass(frozen=True)
class PipelineConfig:
    """How the stages are wired (pipeline/)."""

    update_lag_frames: int = within(1, 10_000, 5)  # a keyframe's MapUpdate is applied before this many frames later
    loop_lag_keyframes: int = 2  # a keyframe's LoopResult reaches the mapper this many keyframes later
    ring_slots: int = above_zero(8)  # image pairs in shared memory between capture and the stages
    threads: int = above_zero(1)  # of OpenCV and BLAS in each process
    cpus: dict[str, tuple[int, ...]] = field(default_factory=dict[str, tuple[int, ...]])  # stage -> cores it may use


@dataclass(frozen=True)
class Config:
    """Everything that decides what a run computes. The resolved tree is saved with every run."""

    seed: int = 0  # of the estimators of --odometry
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    manhattan: ManhattanConfig = field(default_factory=ManhattanConfig)
    mapper: MapperConfig = field(default_factory=MapperConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    pipeline: PipelineConfig = field(default_factory=PipelineConfig)

    def closes_loops(self, depth: bool, localize_only: bool) -> bool:
        """Whether a run looks for loops: it maps, and its camera knows depth (two eyes, or a depth image)."""
        return self.loop.enabled and self.mapper.enabled and depth and not localize_only


def _merge(base: dict[str, Any], extra: dict[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in extra.items():
        old = out.get(key)
        out[key] = _merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return out


def from_dict(data: dict[str, Any]) -> Config:
    """Nested plain values over the defaults.

    Raises:
        StereoSfmError: an unknown key, a value of the wrong type, or one that its field does not take.
    """
    import dacite

    merged = _merge(dataclasses.asdict(Config()), data)
    rules = dacite.Config(strict=True, type_hooks={float: _as_float}, cast=[tuple])
    try:
        config = dacite.from_dict(Config, merged, rules)
    except dacite.DaciteError as error:
        raise StereoSfmError(f"configuration: {error} (see 'stereo-sfm config dump' for every key)") from None
    _check(config)
    unknown = sorted(set(config.pipeline.cpus) - set(STAGES))
    if unknown:
        raise StereoSfmError(f"configuration: pipeline.cpus names '{unknown[0]}': the stages are {', '.join(STAGES)}")
    return config


def _check(section: Any, place: str = "") -> None:
    """Raises StereoSfmError for a word or a number that a field does not take."""
    for f in dataclasses.fields(section):
        name, value = place + f.name, getattr(section, f.name)
        words: tuple[str, ...] = f.metadata.get("words", ())
        if dataclasses.is_dataclass(value):
            _check(value, f"{name}.")
        elif words and value not in words:
            raise StereoSfmError(f"configuration: {name} is '{value}': choose one of {', '.join(words)}")
        elif "range" in f.metadata and not f.metadata["range"][0] <= value <= f.metadata["range"][1]:
            least, most = f.metadata["range"]
            raise StereoSfmError(f"configuration: {name} is {value}: it must be from {least} to {most}")
        elif isinstance(value, int) and value > MOST:
            raise StereoSfmError(f"configuration: {name} is {value}: it is too large")
        elif f.metadata.get("above_zero") and not value > 0:
            raise StereoSfmError(f"configuration: {name} is {value:g}: it must be above 0")
        elif isinstance(value, int | float) and not value >= 0:
            raise StereoSfmError(f"configuration: {name} is {value:g}: it must be at least 0")


def _as_float(value: Any) -> Any:
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def load(path: Path | None = None, overrides: Iterable[str] = (), base: dict[str, Any] | None = None) -> Config:
    """Defaults, `base`, a TOML file, then `key.subkey=value` overrides, values read as TOML (else as text)."""
    data: dict[str, Any] = base or {}
    if path is not None:
        try:
            data = _merge(data, tomllib.loads(path.read_text("utf-8-sig")))
        except FileNotFoundError:
            raise StereoSfmError(f"no configuration file at {path}") from None
        except OSError as error:
            raise StereoSfmError(f"cannot read the configuration {path}: {error.strerror}") from None
        except UnicodeDecodeError:
            raise StereoSfmError(f"configuration {path}: it is no text (expected TOML)") from None
        except tomllib.TOMLDecodeError as error:
            raise StereoSfmError(f"configuration {path}: {error}") from None
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals:
            raise StereoSfmError(f"--set takes key=value, got '{override}'")
        try:
            tree = tomllib.loads(f"{key} = {value}")
        except tomllib.TOMLDecodeError:
            try:
                tree = tomllib.loads(f"{key} = {value!r}")
            except tomllib.TOMLDecodeError:
                raise StereoSfmError(f"--set cannot read '{override}'") from None
        data = _merge(data, tree)
    return from_dict(data)


def dump(config: Config) -> str:
    """The whole tree as TOML that `load` reads back."""
    import tomli_w

    return tomli_w.dumps(dataclasses.asdict(config))
