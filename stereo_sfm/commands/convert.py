"""`stereo-sfm convert`: a dataset folder (or another recording) as an MCAP file."""

from __future__ import annotations

import argparse

from stereo_sfm.commands.record import add_output_arguments, write
from stereo_sfm.errors import StereoSfmError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("source", metavar="FOLDER", help="a dataset folder, an .mcap file, or KIND:PATH")
    add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Convert everything that the source holds."""
    from stereo_sfm.commands.run import source_choice

    choice = source_choice(args)
    choice.refuse_to_overwrite(args.output)
    with choice() as source:
        if source.live:
            raise StereoSfmError(f"{source.name} is a device: use 'stereo-sfm record {args.source}'")
        return write(source, args, "convert", choice.opening)
