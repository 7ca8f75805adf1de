"""`stereo-sfm info`: describe a recording or dataset folder and its problems."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.errors import StereoSfmError

if TYPE_CHECKING:
    from stereo_sfm.recording.describe import Description, Rate


_SHOWN = ("images", "dropped", "max_skew_ns")  # totals in the line about the images


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("source", help="an .mcap file, a ROS bag or a dataset folder, also as KIND:PLACE?OPTION=VALUE")
    parser.add_argument("--rig", type=Path, help="calibration file to use instead of the recording's own")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Describe and return 0, also when problems are found and printed."""
    from stereo_sfm.drivers.registry import driver, recognise
    from stereo_sfm.drivers.source import look_up, path_of
    from stereo_sfm.recording.describe import describe_dataset, describe_file
    from stereo_sfm.storage.remote import Remote, is_uri, place

    if is_uri(args.source):
        named = look_up(args.source, args.rig)
        file = place(named.place)
        found = describe_file(file, args.rig) if isinstance(file, Remote) else describe_dataset(file, args.rig)
        print(found.as_json() if args.json else "\n".join(_lines(found)))
        return 0
    path = path_of(args.source)
    if not path.exists():
        look_up(args.source, args.rig)  # the driver's own check knows more
        kind, colon, _ = args.source.partition(":")
        if colon and not driver(kind).of_files:
            raise StereoSfmError(f"{args.source} is no recording: 'stereo-sfm sources {kind}' describes it")
        raise StereoSfmError(f"no such file or folder: {path}")
    if (path / "run.mcap").is_file():
        path /= "run.mcap"
    in_one_file = path.is_file() and recognise(path) == "mcap"
    found = describe_file(path, args.rig) if in_one_file else describe_dataset(args.source, args.rig)
    print(found.as_json() if args.json else "\n".join(_lines(found)))
    return 0


def _lines(found: Description) -> list[str]:
    lines = [f"{found.path}: {found.seconds:.2f} s"]
    if found.kind == "mcap":
        rate = f", {found.bytes / found.seconds / 1e6:.1f} MB/s" if found.seconds > 0 else ""
        lines[0] += f", {found.bytes / 1e6:.1f} MB{rate}, {found.messages} messages, "
        lines[0] += found.truncated or "closed properly"
    lines += [f"  {key:<14} {value}" for key, value in found.metadata.items() if value]
    if found.config_sha256 and "config_sha256" not in found.metadata:
        lines.append(f"  {'config_sha256':<14} {found.config_sha256}")
    if found.images is not None:
        what = "frames, without their images" if found.metadata.get("image_format") == "none" else "images"
        lines.append(f"{what}: {_rate(found.images)}, {found.dropped} dropped" + _skew(found))
    rest = {name: value for name, value in found.totals.items() if name not in _SHOWN}
    if rest:
        lines.append("totals: " + ", ".join(f"{value} {name}" for name, value in rest.items()))
    if found.ground_truth:
        lines.append(f"ground truth: {found.ground_truth} poses")
    lines += [f"calibration: {line}" for line in found.calibration]
    if found.rows:
        width = max(len(topic) for topic, _, _ in found.rows)
        wide = max(len(schema) for _, schema, _ in found.rows)
        lines += [f"  {topic:<{width}}  {schema:<{wide}}  {_rate(rate)}" for topic, schema, rate in found.rows]
    lines += [f"problem: {problem}" for problem in found.problems]
    return lines if found.problems else [*lines, "no problems found"]


def _skew(found: Description) -> str:
    return "" if math.isnan(found.skew_ms) else f", left and right at most {found.skew_ms:.3f} ms apart"


def _rate(rate: Rate) -> str:
    if math.isnan(rate.hz):
        return f"{rate.count}"
    gaps = f", {rate.gaps} gaps up to {rate.longest_gap_s:.3f} s" if rate.gaps else ""
    jitter = "" if math.isnan(rate.jitter_ms) else f", jitter {rate.jitter_ms:.2f} ms"
    return f"{rate.count} at {rate.hz:.2f} Hz{jitter}{gaps}"
