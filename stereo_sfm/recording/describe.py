"""Contents and problems of a recording or dataset folder: rates, jitter, gaps, skew, calibration."""

from __future__ import annotations

import json
import logging
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from stereo_sfm.calib.lengths import unchecked_lengths
from stereo_sfm.calib.lens_doubts import doubts
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.start import check_start
from stereo_sfm.calib.sticking import positions, with_sticking
from stereo_sfm.drivers.folder_source import FolderSource
from stereo_sfm.drivers.source import Source
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.log import topics
from stereo_sfm.log.attached import attached_rig
from stereo_sfm.log.provenance import CONFIG_FILE, ENDED_EARLY, METADATA, TOTALS, config_hash
from stereo_sfm.log.reader import LogReader, TopicInfo
from stereo_sfm.log.recorded import messages
from stereo_sfm.pixels import DARK
from stereo_sfm.storage.remote import Place
from stereo_sfm.types import F64, I64, StereoImage

log = logging.getLogger("stereo_sfm")

SAMPLED = 9  # frames whose pixels are looked at
NO_LIGHT = f"no pixel brighter than {DARK} grey levels: more light, a longer exposure, a covered lens?"
NO_CONTRAST = "an image of one even grey: a covered lens?"
LEAST_CONTRAST = 8  # grey levels between the darkest and the brightest pixel of an image that shows something
GAP = 1.5  # periods without a frame that count as a gap
MAX_SKEW_MS = 1.0  # between the cameras, above which tracking degrades
MAX_JITTER = 0.2  # of the period
IMAGE_TOPICS = (topics.LEFT_IMAGE, topics.FRAME)  # whose gaps and jitter decide about problems
FEW = 1000  # messages of a topic in a bucket whose stamps are all read, too


@dataclass(frozen=True)
class Rate:
    """Regularity of stamps. Milliseconds; NaN with fewer than three stamps."""

    count: int
    hz: float
    jitter_ms: float  # 95 % of the intervals are within this of the median
    gaps: int
    longest_gap_s: float
    missing: int  # estimated frames lost in the gaps
    backwards: int  # stamps not later than the previous one


@dataclass
class Description:
    """Everything `info` prints."""

    path: str
    kind: str
    seconds: float = 0.0
    bytes: int = 0
    messages: int = 0
    truncated: str = ""
    metadata: dict[str, str] = field(default_factory=dict[str, str])
    totals: dict[str, str] = field(default_factory=dict[str, str])
    config_sha256: str = ""
    rows: list[tuple[str, str, Rate]] = field(default_factory=list[tuple[str, str, Rate]])  # topic, schema, rate
    images: Rate | None = None
    dropped: int = 0
    skew_ms: float = float("nan")  # largest difference between the cameras' stamps
    calibration: list[str] = field(default_factory=list[str])
    ground_truth: int = 0
    problems: list[str] = field(default_factory=list[str])

    def as_json(self) -> str:
        """As JSON values; NaN becomes null."""
        text = json.dumps(asdict(self), default=str)
        return json.dumps(json.loads(text, parse_constant=lambda _: None), indent=2)


def rate_of(stamps: I64) -> Rate:
    """Regularity of ascending stamps in nanoseconds."""
    nan = float("nan")
    steps = np.diff(stamps)
    forward = steps[steps > 0]
    if len(forward) < 2:
        return Rate(len(stamps), nan, nan, 0, 0.0, 0, int((steps <= 0).sum()))
    period = float(np.median(forward))
    wide = forward[forward > GAP * period]
    jitter = float(np.percentile(np.abs(forward[forward <= GAP * period] - period), 95))
    missing = int(np.maximum(np.round(wide / period) - 1, 1).sum())
    longest = float(wide.max()) / 1e9 if len(wide) else 0.0
    return Rate(len(stamps), 1e9 / period, jitter / 1e6, len(wide), longest, missing, int((steps <= 0).sum()))


def describe_file(path: Place, rig: Path | None = None) -> Description:
    """Describe an MCAP file, ours or not; `rig` replaces its calibration or provides a missing one.

    Raises:
        StereoSfmError: no such file, or not MCAP.
    """
    with _warnings() as warned:
        out = _describe_file(path, rig)
    return _with_warnings(out, warned)


def _describe_file(path: Place, own_rig: Path | None) -> Description:
    with LogReader(path) as reader:
        rates = {topic.topic: _regularity(reader, topic) for topic in reader.topics}
        ends = [ends for name, (_, *ends) in rates.items() if name != topics.GROUND_TRUTH and any(ends)]
        seconds = (max(last for _, last in ends) - min(first for first, _ in ends)) / 1e9 if ends else 0.0
        out = Description(
            str(path), "mcap", seconds, reader.bytes, truncated=reader.truncated,
            metadata=reader.metadata(METADATA),
        )  # fmt: skip
        config = reader.attachment(CONFIG_FILE)
        out.config_sha256 = config_hash(config.decode(errors="replace")) if config is not None else ""
        for topic in reader.topics:
            out.rows.append((topic.topic, topic.schema or topic.encoding, rates[topic.topic][0]))
            out.messages += topic.count
        _describe_infos(out, reader)
        _compare_cameras(out, {topic.topic: topic.count for topic in reader.topics})
        lean = out.metadata.get("image_format") == "none"
        if lean:
            rig = attached_rig(reader)
            if rig is None:
                out.problems.append("the calibration is damaged")
            else:
                out.calibration = rig_lines(rig)
            out.images = rate_of(reader.stamps(topics.FRAME))
    if lean and (out.images is None or not out.images.count):
        out.problems.append("no frames")
    if ENDED_EARLY.items() <= out.metadata.items():
        out.problems.append("the run was killed: the final messages of its stages are missing")
    if out.truncated:
        out.problems.append(f"{out.truncated} ('stereo-sfm recover' writes a repaired copy)")  # as the reader warns
    if not lean:
        _describe_source(out, str(path), own_rig)
    return out


def _regularity(reader: LogReader, topic: TopicInfo) -> tuple[Rate, int, int]:
    """Rate of a topic, its first and its last stamp.

    In a bucket only images have every stamp read: those of an IMU are some megabytes of the index.
    """
    if reader.distant and topic.topic not in IMAGE_TOPICS and topic.count > FEW:
        first, last = reader.span_ns(topic.topic)
        if last > first:
            nan = float("nan")
            return Rate(topic.count, (topic.count - 1) * 1e9 / (last - first), nan, 0, 0.0, 0, 0), first, last
    stamps = reader.stamps(topic.topic)
    first, last = (int(stamps[0]), int(stamps[-1])) if len(stamps) else (0, 0)
    return rate_of(stamps), first, last


@contextmanager
def _warnings() -> Generator[list[str]]:
    """What readers warn about while a recording is opened and read: each is listed once, and not shown."""
    found: dict[str, None] = {}

    def keep(record: logging.LogRecord) -> bool:
        if record.levelno < logging.WARNING:
            return True
        found[record.getMessage()] = None
        return False

    texts: list[str] = []
    log.addFilter(keep)
    try:
        yield texts
    finally:
        log.removeFilter(keep)
        texts += found


def _with_warnings(out: Description, warned: list[str]) -> Description:
    """Add the warnings that no problem says already: what a run would warn about is a problem."""
    out.problems += [text for text in warned if not any(problem in text or text in problem for problem in out.problems)]
    return out


def describe_dataset(spec: str | Path, rig: Path | None = None) -> Description:
    """Describe a dataset folder of any known kind, or a ROS bag, also as `KIND:PLACE?OPTIONS`.

    `rig` as in `describe_file`.

    Raises:
        StereoSfmError: not a known dataset.
    """
    from stereo_sfm.drivers.source import path_of

    out = Description(str(spec), "folder" if path_of(str(spec)).is_dir() else "bag")
    with _warnings() as warned:
        _describe_source(out, spec, rig)
    return _with_warnings(out, warned)


def _describe_infos(out: Description, reader: LogReader) -> None:
    """Skew and drops as stored in our recordings: totals at the end, else (not closed) in every message."""
    out.totals = reader.metadata(TOTALS)
    if out.totals:
        try:
            out.dropped, skew_ns = int(out.totals["dropped"]), int(out.totals["max_skew_ns"])
            out.skew_ms = skew_ns / 1e6
            return
        except (LookupError, ValueError, OverflowError):
            out.problems.append("the totals are damaged: they are counted again")
            out.totals, out.dropped = {}, 0
    skews = [0]
    infos = 0
    for _, info in messages(reader, [topics.IMAGE_INFO]):
        infos += 1
        out.dropped += info.dropped_before
        if info.has_right and info.right_stamp_ns:
            skews.append(abs(info.right_stamp_ns - info.stamp_ns))
    if infos:
        out.skew_ms = max(skews) / 1e6


def _compare_cameras(out: Description, counts: dict[str, int]) -> None:
    """Our recordings list the images of every frame."""
    frames = counts.get(topics.IMAGE_INFO, 0)
    for topic in (topics.LEFT_IMAGE, topics.RIGHT_IMAGE, topics.DEPTH_IMAGE):
        if 0 < counts.get(topic, frames) < frames:
            out.problems.append(
                f"{frames - counts[topic]} of {frames} images of {topic} are missing: those frames are skipped"
            )


def _describe_source(out: Description, spec: str | Path, rig: Path | None) -> None:
    from stereo_sfm.drivers.source import open_source

    try:
        source = open_source(spec, rig)
    except StereoSfmError as error:
        if out.kind != "mcap":
            raise
        out.problems.append(str(error))
        return
    with source:
        out.calibration = rig_lines(source.rig)
        out.problems += doubts(source.rig)
        out.ground_truth = 0 if source.ground_truth is None else len(source.ground_truth)
        listed = source.stamps()
        stamps = np.array([image.stamp_ns for image in source], np.int64) if listed is None else listed.stamp_ns
        out.images = rate_of(stamps)
        if listed is not None:
            out.skew_ms = listed.skew_ms if np.isnan(out.skew_ms) else out.skew_ms
            if listed.assumed_hz:
                out.problems.append(
                    f"nothing tells when the images were taken: {listed.assumed_hz:g} a second are assumed "
                    "(?fps=N, a times.txt beside the folders, or names that are stamps)"
                )
            out.rows += [(name, "samples beside the images", rate_of(times)) for name, times in listed.others.items()]
        if out.kind != "mcap":
            out.metadata["source"] = source.name
            out.seconds = float(stamps[-1] - stamps[0]) / 1e9 if len(stamps) else 0.0
        broken, unlit = _unseen(source, len(stamps))
        lengths = unchecked_lengths(source.rig, source)  # of the first images, which are at hand now
        out.calibration += [lengths] if lengths else []
        out.problems += [*broken, *(unlit or _against_calibration(source))]
    out.problems += _problems(out)


def _unseen(source: Source, count: int) -> tuple[list[str], list[str]]:
    """Sampled frames that cannot be read or show nothing: from all of a folder, else the first ones, if all of them."""
    spread = isinstance(source, FolderSource)  # images between are not read
    some = min(SAMPLED, count)
    positions = sorted({k * (count - 1) // max(some - 1, 1) for k in range(some)}) if spread else range(some)
    try:
        unlit = [_shows_nothing(image) for image in source.at(positions)]
    except StereoSfmError as error:
        return [], [str(error)]
    unread = some - len(unlit) if spread else 0
    broken = [f"{unread} of {some} sampled frames cannot be read: damaged or missing files"] if unread else []
    of, least = f"of {len(unlit)} sampled frames", 1 if spread else max(len(unlit), 1)
    counts = ((unlit.count(what), what) for what in (NO_LIGHT, NO_CONTRAST))
    return broken, [f"{n} {of} have {what}" for n, what in counts if n >= least]


def _against_calibration(source: Source) -> list[str]:
    """What the first images say against the calibration, as at the start of a run."""
    try:
        found = check_start(source.rig, source, source.other_reading)
        found = with_sticking(found, source.rig, source.at(positions(source.frame_count)))
    except StereoSfmError as error:
        return [str(error)]
    if not found.text:
        return []
    done = "corrects" if found.rig is not None else "masks" if found.masked is not None else ""
    return [f"{found.text}: a run {done} it at its start; {found.advice}" if done else found.text]


def _shows_nothing(image: StereoImage) -> str:
    """What is wrong with an image of a frame, or ""."""
    sides = [side for side in (image.left, image.right) if side is not None]
    if any(side.max() < DARK for side in sides):
        return NO_LIGHT
    return NO_CONTRAST if any(np.ptp(side) < LEAST_CONTRAST for side in sides) else ""


def _problems(out: Description) -> list[str]:
    found: list[str] = []
    rate = out.images
    if rate is None or not rate.count:
        return [*found, "no usable images"]
    if rate.backwards:
        found.append(f"{rate.backwards} image stamps are not later than the previous one")
    if rate.gaps:
        found.append(
            f"{rate.gaps} gaps between images (longest {rate.longest_gap_s:.3f} s, about {rate.missing} frames missing)"
        )
    if rate.jitter_ms > MAX_JITTER * 1e3 / rate.hz:
        found.append(f"image stamps jitter by {rate.jitter_ms:.1f} ms: are they stamps of the sensor?")
    if out.skew_ms > MAX_SKEW_MS:
        found.append(f"the cameras are up to {out.skew_ms:.2f} ms apart: in motion they see different scenes")
    return found


def rig_lines(rig: Rig) -> list[str]:
    """The calibration as text, one line per camera and one for the pair."""
    lines = [f"left  {_camera_line(rig.left)}{_mask_text(rig.masked_share[0])}"]
    if rig.readout_s:
        lines.append(f"rolling shutter, {rig.shutter}")
    if rig.depth:
        lines.append(f"depth image, virtual baseline {rig.baseline * 1e3:.1f} mm")
    elif rig.right is None:
        lines.append("one camera")
    else:
        angle = np.degrees(se3.extent(rig.left_T_right)[1])
        lines.append(f"right {_camera_line(rig.right)}{_mask_text(rig.masked_share[1])}")
        lines.append(f"baseline {rig.baseline * 1e3:.2f} mm, relative rotation {angle:.2f} deg")
    return lines + _sensor_lines(rig)


def _sensor_lines(rig: Rig) -> list[str]:
    """IMU and wheels, one line each."""
    lines: list[str] = []
    if rig.imu is not None:
        lines.append(
            f"IMU   {rig.imu.rate_hz:g} Hz, {_place(rig.imu.left_T_imu)}, offset {1e3 * rig.imu.offset_s:g} ms"
        )
    if rig.wheel is not None:
        radii = "/".join(f"{1e3 * r:.2f}" for r in rig.wheel.radii_m)
        size = f", radii {radii} mm, track {1e3 * rig.wheel.track_m:.1f} mm" if radii else ""
        where = f"{_place(rig.wheel.left_T_wheel)}, offset {1e3 * rig.wheel.offset_s:g} ms"
        lines.append(f"wheels {rig.wheel.model}{size}, {where}")
    return lines


def _place(left_T_sensor: F64) -> str:
    x, y, z = (1e3 * left_T_sensor[:3, 3]).tolist()
    return f"at ({x:.1f}, {y:.1f}, {z:.1f}) mm of the left camera"


def _mask_text(share: float) -> str:
    return f", {100 * share:.0f} % masked" if share else ""


def _camera_line(camera: Camera) -> str:
    distortion = ", ".join(f"{d:.5g}" for d in camera.distortion)
    return (
        f"{camera.model} {camera.width}x{camera.height} fx {camera.fx:.2f} fy {camera.fy:.2f} "
        f"cx {camera.cx:.2f} cy {camera.cy:.2f}" + (f" distortion {distortion}" if distortion else "")
    )
