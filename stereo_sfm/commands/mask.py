"""`stereo-sfm mask`: find the parts of the images that show the robot itself, or nothing, in a recording."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import add_source, add_source_arguments, source_choice, typed
from stereo_sfm.commands._progress import progress
from stereo_sfm.commands._stop import INTERRUPTED, StopRequest
from stereo_sfm.errors import StereoSfmError

if TYPE_CHECKING:
    from stereo_sfm.calib.mask_search import FoundMask, MaskSearch
    from stereo_sfm.calib.rig import Rig


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    add_source(parser)
    add_source_arguments(parser)
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE.png",
        help="mask of the left camera; FILE_right.png and FILE.yaml, the calibration with both, are written beside it",
    )  # fmt: skip
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress and no summary")


@dataclass(frozen=True)
class MaskOptions:
    """Options of this command, as the parser names them."""

    output: Path
    overwrite: bool
    quiet: bool

    @property
    def right(self) -> Path:
        return self.output.with_name(f"{self.output.stem}_right.png")

    @property
    def rig(self) -> Path:
        return self.output.with_suffix(".yaml")


def run(args: argparse.Namespace) -> int:
    """Track the recording, find the masks, write them."""
    options, choice = typed(MaskOptions, args), source_choice(args)
    _check(options)
    from stereo_sfm.calib.mask_search import MaskSearch
    from stereo_sfm.config import TrackerConfig
    from stereo_sfm.tracking.flow.tracker import Tracker

    with StopRequest() as stop, choice() as source:
        tracker, masks = Tracker(TrackerConfig(), source.rig), MaskSearch()
        with progress(source.name, source.frame_count, options.quiet) as bar:
            for image in source:
                if image.right is not None or image.depth is not None:
                    masks.add_tracked(image, *tracker.step(image))
                bar.step("tracking")
                if stop.asked:
                    break
        _write(masks, source.rig, options)
        return INTERRUPTED if stop.asked and not source.live else 0


def _check(options: MaskOptions) -> None:
    if options.output.suffix != ".png":
        raise StereoSfmError(f"{options.output} does not end in .png: masks are PNG files")
    existing = [p for p in (options.output, options.right, options.rig) if p.exists()]
    if existing and not options.overwrite:
        raise StereoSfmError(f"{existing[0]} exists: choose another name or give --overwrite")


def _write(masks: MaskSearch, rig: Rig, options: MaskOptions) -> None:
    from stereo_sfm.calib import save_rig
    from stereo_sfm.calib.mask import encode_mask
    from stereo_sfm.calib.mask_search import masked

    found = masks.find()
    new = masked(rig, found)
    for path, mask in ((options.output, new.left_mask), (options.right, new.right_mask)):
        if mask is not None:
            path.write_bytes(encode_mask(mask))
    save_rig(new, options.rig)
    if not options.quiet:
        for side, one in zip(("left", "right"), found, strict=False):
            print(f"{side} image: {_text(one)}")
        print(f"{options.rig}: the calibration with these masks; use it with --rig {options.rig}")


def _text(found: FoundMask) -> str:
    fixed, dark = 100 * found.fixed.mean(), 100 * found.dark.mean()
    return f"{fixed:.1f} % stays in place while the camera turns, {dark:.1f} % is always dark; black in the mask"
