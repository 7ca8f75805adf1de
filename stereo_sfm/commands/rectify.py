"""`stereo-sfm rectify`: rectified image pairs with epipolar lines for inspection, the rig, and the row error."""

from __future__ import annotations

import argparse
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import add_source

if TYPE_CHECKING:
    from collections.abc import Iterator

    from stereo_sfm.drivers.source import Source
    from stereo_sfm.types import StereoImage


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    add_source(parser)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the images and rig.yaml")
    parser.add_argument("--projection", choices=("epipolar", "pinhole"), default="epipolar")
    parser.add_argument("--hfov", type=float, default=None, metavar="DEG", help="horizontal field of view")
    parser.add_argument("--size", default=None, metavar="WxH", help="size of the rectified images")
    parser.add_argument("--rig", type=Path, default=None, help="calibration to use instead of the source's own")
    parser.add_argument(
        "--frames", type=int, default=5, help="pairs to write, evenly spread over the source (default: 5)"
    )
    parser.add_argument("--plain", action="store_true", help="write the left and right images without lines")
    parser.add_argument("--overwrite", action="store_true", help="write into a folder that is not empty")


def run(args: argparse.Namespace) -> int:
    """Write the images, print the row error."""
    import numpy as np

    from stereo_sfm.calib import save_rig
    from stereo_sfm.calib.drawing import side_by_side
    from stereo_sfm.calib.matches import match_pair
    from stereo_sfm.calib.rectification import rectify
    from stereo_sfm.drivers.source import open_source
    from stereo_sfm.pixels import write_image

    if args.frames < 1:
        raise _error("--frames must be at least 1")
    if args.output.exists() and any(args.output.iterdir()) and not args.overwrite:
        raise _error(f"{args.output} is not empty: choose another folder or give --overwrite")
    errors: list[np.ndarray] = []
    with open_source(args.source, args.rig) as source:
        rectification = rectify(source.rig, args.projection, args.hfov, parse_size(args.size))
        for image in spread(source, args.frames):
            if image.right is None:
                raise _error(f"frame {image.frame_id} has no right image")
            left, right = rectification.apply(image.left, image.right)
            if not errors:  # only now, when the calibration is known to match the images
                args.output.mkdir(parents=True, exist_ok=True)
                save_rig(rectification.rig, args.output / "rig.yaml")
            matches = match_pair(rectification, left, right)
            errors.append(matches.row_error)
            pair = f"pair_{image.frame_id:06d}"
            if args.plain:
                write_image(args.output / f"{pair}_left.png", left)
                write_image(args.output / f"{pair}_right.png", right)
            else:
                write_image(args.output / f"{pair}.png", side_by_side(left, right, matches))
    if not errors:
        raise _error(f"{args.source} gave no images")
    camera = rectification.rig.left
    fov = 2 * np.arctan(0.5 * camera.width / camera.fx) if args.projection == "pinhole" else camera.width / camera.fx
    print(f"{len(errors)} pairs in {args.output}, {args.projection} {camera.width}x{camera.height} px,", end=" ")
    print(f"{np.rad2deg(fov):.0f} degrees wide")
    row = np.concatenate(errors)
    if len(row) < 20:
        print(f"only {len(row)} matches: too few to measure the row error")
        return 0
    size = np.abs(row)
    print(f"row error of {len(row)} matches: median {np.median(row):+.2f} px,", end=" ")
    print(f"median size {np.median(size):.2f}, 95 % below {np.quantile(size, 0.95):.2f} px")
    return 0


def parse_size(text: str | None) -> tuple[int, int] | None:
    """`640x480` -> (640, 480)."""
    if text is None:
        return None
    width, cross, height = text.lower().partition("x")
    if not cross or not width.isdigit() or not height.isdigit() or min(int(width), int(height)) < 16:
        raise _error(f"a size is WIDTHxHEIGHT in pixels, got '{text}'")
    return int(width), int(height)


def spread(source: Source, count: int) -> Iterator[StereoImage]:
    """About `count` frames evenly spread over the source, or the first ones if its length is unknown."""
    known = source.frame_count if not source.live else None
    step = max(1, (known or count) // count)
    return islice(source.at(range(0, known or count, step)), count)


def _error(text: str) -> Exception:
    from stereo_sfm.errors import StereoSfmError

    return StereoSfmError(text)
