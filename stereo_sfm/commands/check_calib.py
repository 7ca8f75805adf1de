"""`stereo-sfm check-calib`: is the calibration of this recording good? PASS and WARN exit with 0, FAIL with 3."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereo_sfm.commands._options import add_source, check_counts, typed

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from stereo_sfm.calib.check import CheckReport, Finding
    from stereo_sfm.calib.mask_search import MaskSearch
    from stereo_sfm.calib.rig import Rig
    from stereo_sfm.tracking.flow.readout import Readout
    from stereo_sfm.tracking.flow.tracker import Tracker
    from stereo_sfm.types import StereoImage

MISTAKE = "images"  # finding of swapped or upside-down images, or an inverted transform
FIXED_SHARE = 0.003  # of an image, from which on the robot in view is worth a mask
DEFAULT_SEARCH = 14  # rows
SIDES = ("left", "right")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    add_source(parser)
    parser.add_argument("--rig", type=Path, default=None, help="calibration file to check instead of the source's own")
    parser.add_argument("--windows", type=int, default=10, help="number of short segments of the recording to use")
    parser.add_argument("--max-frames", type=int, default=600, help="stop after N frames")
    parser.add_argument(
        "--search",
        type=int,
        default=None,
        metavar="ROWS",
        help="search range for row errors, in rows above and below (default: 14, or what the first images need)",
    )
    parser.add_argument("--correct", type=Path, default=None, metavar="FILE", help="write the corrected rig to FILE")
    parser.add_argument("--overwrite", action="store_true", help="replace the file of --correct")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


@dataclass(frozen=True)
class CheckOptions:
    """Options of this command, as the parser names them."""

    source: str
    rig: Path | None
    windows: int
    max_frames: int
    search: int | None
    correct: Path | None
    overwrite: bool
    json: bool


def run(args: argparse.Namespace) -> int:
    """Collect, judge, print."""
    options = typed(CheckOptions, args)
    import itertools
    import json
    from dataclasses import replace

    from stereo_sfm.calib import save_rig
    from stereo_sfm.calib.check import Finding, check
    from stereo_sfm.calib.mask_search import MaskSearch
    from stereo_sfm.calib.rectification import rectify
    from stereo_sfm.calib.tracks import MAX_FRAMES, collect, corners_for
    from stereo_sfm.calib.wrong_rig import search_rows
    from stereo_sfm.config import Config
    from stereo_sfm.drivers.source import open_source
    from stereo_sfm.drivers.start_checked import StartCheckedSource
    from stereo_sfm.eval.sensor_motion import SensorMotion
    from stereo_sfm.tracking.flow.readout import ReadoutSearch
    from stereo_sfm.tracking.flow.tracker import Tracker

    _check(options)
    with StartCheckedSource(open_source(options.source, options.rig), correct=True) as source:
        rig = source.given_rig
        rectification = rectify(rig, "epipolar")
        source.look()  # at a live camera's images, too: the given calibration is checked, whatever they say
        images = itertools.islice(source, options.max_frames)
        start = source.start_check
        corrected = start is not None and start.rig and source.contradicted
        widely = search_rows(rectification) if corrected else DEFAULT_SEARCH
        total = min(source.frame_count or options.max_frames, options.max_frames)
        gap = 0 if source.live else max(0, total // options.windows - MAX_FRAMES)
        corners = corners_for(total, options.windows)
        shutter, masks, errors_px = ReadoutSearch(rig), MaskSearch(), list[float]()
        motion = SensorMotion(rig) if rig.imu is not None or rig.wheel is not None else None
        images = _searched(images, Tracker(Config().tracker, rig, readout=shutter), masks, errors_px)
        images = images if motion is None else motion.watch(images)
        windows = collect(images, rectification, options.windows, gap, corners, options.search or widely)
        readout = shutter.measured
        mistake = "" if start is None or start.rig else start.text
        report = _checked(lambda: check(rig, rectification, windows, rolling=readout.best_s != 0), mistake)
        level = 2 if mistake or source.contradicted else 1  # a warning of what sticks, and can be masked
        others = [] if start is None else [Finding(MISTAKE if mistake else "first images", level, start.text)]
        others += [
            _shutter(rig.shutter, readout, errors_px),
            *_robot(masks, rig),
            *(motion.findings() if motion else []),
        ]
        report = replace(report, findings=(*report.findings, *others))
    if options.correct is not None:
        save_rig(report.choice.apply(rig), options.correct)
    if options.json:
        print(json.dumps(as_dict(report), indent=2))
    else:
        print(as_text(report, str(options.source)))
        if options.correct is not None:
            print("\n".join(_written(report, options.correct)))
    return 3 if report.verdict == "FAIL" else 0


def _searched(
    images: Iterable[StereoImage], tracker: Tracker, masks: MaskSearch, errors_px: list[float]
) -> Iterator[StereoImage]:
    """Pass the images on, tracked once: for the rolling shutter, the robot in view, and the points' median errors."""
    for image in images:
        if image.right is not None:
            masks.add_tracked(image, *tracker.step(image))
            if tracker.solution is not None:
                errors_px.append(tracker.solution.residual_px)
        yield image


def _checked(check: Callable[[], CheckReport], mistake: str) -> CheckReport:
    """The report; where the images cannot be matched, the mistake between images and calibration is the error."""
    from stereo_sfm.errors import StereoSfmError

    try:
        return check()
    except StereoSfmError as error:
        if mistake:
            raise StereoSfmError(mistake) from error
        raise


def _shutter(known: str, readout: Readout, errors_px: list[float]) -> Finding:
    from statistics import fmean

    from stereo_sfm.calib.check import UNKNOWN, Finding

    below = "from below " if readout.measured_s < 0 else ""
    if not readout.known:
        return Finding("shutter", 0, f"{known}; {UNKNOWN} unsteadily", judged=False)
    if not readout.differs:
        error = f"points are off by {fmean(errors_px):.2f} px (median)"
        return Finding("shutter", 0, f"{known}; {error}; measured from the motion: {readout.text}")
    what = "check readout_s in rig.yaml" if readout.calibrated_s else "set readout_s in rig.yaml (see the data sheet)"
    return Finding("shutter", 1, f"{known}, but the motion shows rows read {below}within {readout.text}: {what}")


def _robot(masks: MaskSearch, rig: Rig) -> list[Finding]:
    """What is seen of the robot itself and not masked; nothing where the recording cannot tell."""
    from stereo_sfm.calib.check import Finding

    if not masks.turned:
        return []
    used = (rig.left_mask, rig.right_mask)
    fixed = [
        found.fixed if mask is None else found.fixed & mask for found, mask in zip(masks.find(), used, strict=False)
    ]
    shares = [float(part.mean()) for part in fixed]
    text = " and ".join(f"{100 * share:.1f} % of the {side} image" for side, share in zip(SIDES, shares, strict=False))
    if max(shares) < FIXED_SHARE:
        return [Finding("mask", 0, f"{text} stays in place while the camera turns")]
    advice = "points there stick to the image: mask it ('stereo-sfm mask')"
    return [Finding("mask", 1, f"{text} stays in place while the camera turns: {advice}")]


def _check(options: CheckOptions) -> None:
    from stereo_sfm.errors import StereoSfmError

    search = DEFAULT_SEARCH if options.search is None else options.search
    check_counts({"--windows": options.windows, "--max-frames": options.max_frames, "--search": search})
    if options.correct is not None and options.correct.exists() and not options.overwrite:
        raise StereoSfmError(f"{options.correct} exists: choose another name or give --overwrite")


def as_text(report: CheckReport, name: str) -> str:
    """The report as text."""
    import numpy as np

    lines = [f"{name}: {report.matches} stereo matches in {report.windows} segments"]
    lines += [f"  {f.verdict or '  - '}  {f.name}: {f.text}" for f in report.findings]
    lines.append("row error by image region (median, px; - without matches):")
    for row in report.region_median:
        lines.append("  " + "  ".join("     -" if np.isnan(v) else f"{v:+6.2f}" for v in row))
    lines.append(f"verdict: {report.verdict}" + (_advice(report) if report.level else ""))
    return "\n".join(lines)


def _written(report: CheckReport, path: Path) -> list[str]:
    """The content of the corrected rig, one line per parameter."""
    lines = [
        f"{path}: {'corrected' if report.choice.selected.any() else 'unchanged, the images support no correction'}"
    ]
    lines += [f"  {term.line}" for term in report.choice.terms]
    kept = "unchanged: they cannot be determined from images alone"
    return [*lines, f"  focal length of both cameras, length of the baseline: {kept}"]


def _advice(report: CheckReport) -> str:
    names = [f.name for f in report.findings if f.level == report.level]
    what = " and ".join(names)
    if report.verdict == "WARN":
        return f" (usable; {what} could be better)"
    if MISTAKE in names:
        return f" ({what}): correct that first"
    return f" ({what}): calibrate again, or try 'check-calib --correct rig.yaml' and check the corrected file"


def as_dict(report: CheckReport) -> dict[str, Any]:
    """Plain values for `--json`."""
    from dataclasses import asdict

    import numpy as np

    return {
        "verdict": report.verdict,
        "matches": report.matches,
        "windows": report.windows,
        "findings": [_finding(f) for f in report.findings],
        "region_median_px": [[None if np.isnan(v) else round(float(v), 3) for v in r] for r in report.region_median],
        "region_count": report.region_count.tolist(),
        "noise_px": report.correction.noise_px,
        "consequences": asdict(report.consequences),
        "terms": [asdict(term) for term in report.choice.terms],
    }


def _finding(finding: Finding) -> dict[str, Any]:
    return {
        "name": finding.name,
        "judged": finding.judged,
        "verdict": finding.verdict or None,
        "text": finding.text,
        "value": list(finding.value),
        "sigma": list(finding.sigma),
    }
