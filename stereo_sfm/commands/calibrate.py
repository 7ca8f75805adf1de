"""`stereo-sfm calibrate`: a rig, a report and a verdict from images of a target; IMU and wheels from any recording."""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import check_counts, typed
from stereo_sfm.commands.convert_calib import NAMES

if TYPE_CHECKING:
    from stereo_sfm.calib.targets import Detection, Target
    from stereo_sfm.types import U8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument(
        "source", help="a folder of left*/right* images, a recording, a live camera, or any other source"
    )
    parser.add_argument("--target", help="charuco, checkerboard, aprilgrid, or a target's YAML file")
    parser.add_argument(
        "--imu", action="store_true", help="time offset and rotation of the IMU from a recording with motion; no target"
    )
    parser.add_argument(
        "--wheel", action="store_true", help="radii, track, direction and time offset of the wheels; no target"
    )
    parser.add_argument(
        "--rig", type=Path, default=None, help="with --imu, --wheel: rig to correct (default: source's)"
    )
    parser.add_argument("--max-frames", type=int, default=1800, help="with --imu, --wheel: stop after N frames")
    parser.add_argument("--columns", type=int, help="inner corners (checkerboard), squares (charuco), tags (aprilgrid)")
    parser.add_argument("--rows", type=int)
    parser.add_argument("--square", type=float, metavar="M", help="side of a square or of an AprilTag in metres")
    parser.add_argument("--ratio", type=float, default=None, help="marker / square (charuco), gap / tag (aprilgrid)")
    parser.add_argument("--dictionary", default="DICT_4X4_50", help="charuco markers, OpenCV's name")
    parser.add_argument(
        "--model", choices=("pinhole", "rational", "kb4"), default="pinhole", help="lens (fisheye: kb4)"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="rig file to write")
    parser.add_argument(
        "--format", choices=NAMES, default=None, help="format of the rig file (default: rig; see convert-calib)"
    )
    parser.add_argument("--report", type=Path, default=None, help="HTML report (default: beside the rig)")
    parser.add_argument("--views", type=int, default=60, help="largest number of views to use")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing rig and report")


@dataclass(frozen=True)
class CalibrateOptions:
    """Options of this command, as the parser names them."""

    source: str
    target: str | None
    imu: bool
    wheel: bool
    rig: Path | None
    max_frames: int
    columns: int | None
    rows: int | None
    square: float | None
    ratio: float | None
    dictionary: str
    model: str
    output: Path
    format: str | None
    report: Path | None
    views: int
    overwrite: bool


def run(args: argparse.Namespace) -> int:
    """Collect views, calibrate, judge, write."""
    options = typed(CalibrateOptions, args)
    check_counts({"--views": options.views, "--max-frames": options.max_frames})
    if options.imu or options.wheel:
        return run_sensors(options)
    from dataclasses import replace

    from stereo_sfm.calib import save_rig
    from stereo_sfm.calib.check import VERDICTS
    from stereo_sfm.calib.coverage import coverage
    from stereo_sfm.calib.quality import judge
    from stereo_sfm.calib.report import write_report
    from stereo_sfm.calib.solve import align_pairs, calibrate
    from stereo_sfm.errors import StereoSfmError

    if options.target is None:
        raise StereoSfmError("calibrate needs --target for the cameras, or --imu or --wheel")
    report: Path = options.report or options.output.with_suffix(".html")
    _check_files(options.output, report, options.overwrite)
    target = make_target(options)
    left, right, kept, size, readout_s = collect(options.source, target, options.views)
    if target.kind == "checkerboard":
        right = align_pairs(left, right)
    calibration = calibrate(left, right, target.points, size, options.model)
    views = [coverage(left, size), coverage(right, size)]
    quality = judge(calibration, min(views, key=lambda v: v.fraction))
    save_rig(replace(calibration.rig, readout_s=readout_s), options.output, options.format)
    report.parent.mkdir(parents=True, exist_ok=True)
    write_report(report, str(options.source), calibration, quality, views, kept[:: max(1, len(kept) // 3)][:3])
    for finding in quality.findings:
        print(f"  {VERDICTS[finding.level]}  {finding.name}: {finding.text}")
    for side, view in zip(("left", "right"), views, strict=True):
        for advice in view.advice:
            print(f"  {side} camera: {advice}")
    print(f"verdict: {VERDICTS[quality.level]}, rig {options.output}, report {report}")
    return 3 if VERDICTS[quality.level] == "FAIL" else 0


def run_sensors(options: CalibrateOptions) -> int:
    """Track, compare with the sensors, judge, write."""
    import itertools
    from dataclasses import replace

    from stereo_sfm.calib import save_rig
    from stereo_sfm.calib.check import VERDICTS
    from stereo_sfm.calib.imu_fit import precision_imu
    from stereo_sfm.calib.wheel_fit import precision_wheel
    from stereo_sfm.drivers.source import open_source
    from stereo_sfm.errors import StereoSfmError
    from stereo_sfm.eval.sensor_motion import SensorMotion

    if options.target is not None:
        raise StereoSfmError("--imu and --wheel need motion, --target needs a target: calibrate the cameras first")
    _check_writable(options.output, options.overwrite)
    with open_source(options.source, options.rig) as source:
        rig, motion = source.rig, SensorMotion(source.rig)
        for image in itertools.islice(source, options.max_frames):
            motion.add(image)
    findings = []
    for wanted, samples, name in ((options.imu, motion.imu, "inertial"), (options.wheel, motion.wheel, "wheel")):
        if wanted and not samples:
            raise StereoSfmError(
                f"{options.source} has no {name} samples: record them with the images, or name another source"
            )
    if options.imu:
        imu = motion.fit_imu()
        rig, findings = replace(rig, imu=imu.imu), precision_imu(imu)
    if options.wheel:
        wheel = motion.fit_wheel()
        rig, findings = replace(rig, wheel=wheel.wheel), findings + precision_wheel(wheel)
    save_rig(rig, options.output, options.format)
    for finding in findings:
        print(f"  {VERDICTS[finding.level]}  {finding.name}: {finding.text}")
    verdict = VERDICTS[max(f.level for f in findings)]
    print(f"verdict: {verdict}, {len(motion.stamp_ns)} frames, rig {options.output}")
    return 3 if verdict == "FAIL" else 0


def _check_files(rig: Path, report: Path, overwrite: bool) -> None:
    """Check before the images are searched that both files can be written without losing existing ones."""
    from stereo_sfm.errors import StereoSfmError

    if rig.resolve() == report.resolve():
        raise StereoSfmError(f"the report would replace the rig {rig}: name another --report")
    for path in (rig, report):
        _check_writable(path, overwrite)
    if report.is_dir():
        raise StereoSfmError(f"cannot write the report {report}: it is a folder, name a file")


def _check_writable(path: Path, overwrite: bool) -> None:
    from stereo_sfm.errors import StereoSfmError

    if path.exists() and not overwrite:
        raise StereoSfmError(f"{path} exists: choose another file or give --overwrite")
    folder = next(p for p in path.absolute().parents if p.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise StereoSfmError(f"cannot write {path}: {folder} is not a writable folder")


def make_target(options: CalibrateOptions) -> Target:
    """The target of the options or of the file."""
    from stereo_sfm.calib.targets import KINDS, Target, read_target
    from stereo_sfm.errors import StereoSfmError, one_of

    assert options.target is not None
    if options.target not in KINDS:
        path = Path(options.target)
        return read_target(path if path.exists() or path.suffix else Path(one_of(options.target, KINDS, "target")))
    if options.columns is None or options.rows is None or options.square is None:
        raise StereoSfmError("a target needs --columns, --rows and --square (metres), or a YAML file as --target")
    ratio = options.ratio if options.ratio is not None else 0.3 if options.target == "aprilgrid" else 0.75
    return Target(options.target, options.columns, options.rows, options.square, ratio, options.dictionary)


def collect(
    source: str, target: Target, limit: int
) -> tuple[list[Detection], list[Detection], list[tuple[U8, U8]], tuple[int, int], float]:
    """Detections of both cameras from a folder of images or from a source, reporting which views are still missing.

    The last value is the readout time in the source's own calibration: images of a target do not show it.
    """
    from stereo_sfm.calib.coverage import coverage
    from stereo_sfm.calib.views import find_pairs, gather, read_pairs, stereo_pairs
    from stereo_sfm.drivers.source import open_source
    from stereo_sfm.errors import StereoSfmError

    def report(number: int, left: list[Detection], right: list[Detection], size: tuple[int, int]) -> None:
        advice = coverage(left, size).advice or coverage(right, size).advice
        seen = f"{len(left[-1])} and {len(right[-1])} corners"
        print(f"view {number}: {seen}; {advice[0] if advice else 'enough views, more do no harm'}", file=sys.stderr)

    folder = Path(source).expanduser()
    readout_s = 0.0
    pairs = find_pairs(folder) if folder.is_dir() and not (folder / "mav0").is_dir() else []
    if pairs:
        found = gather(read_pairs(pairs), target, limit, every_view=True, report=report)
    else:
        with open_source(source) as opened:
            try:
                found = gather(stereo_pairs(iter(opened)), target, limit, every_view=False, report=report)
            except KeyboardInterrupt:
                raise StereoSfmError("interrupted before the calibration was computed") from None
            readout_s = opened.rig.readout_s
    if not found[0]:
        raise StereoSfmError(f"no {target.kind} of {target.columns} x {target.rows} in {source}: check its layout")
    return *found, readout_s
