"""`stereo-sfm convert`: a dataset folder (or another recording) as an MCAP file."""

from __future__ import annotations

import argparse

from stereo_sfm.commands._options import add_source, source_choice, typed
from stereo_sfm.commands.record import RecordOptions, add_output_arguments, to_place
from stereo_sfm.errors import StereoSfmError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    add_source(parser)
    add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Convert the whole source."""
    options, choice = typed(RecordOptions, args), source_choice(args)
    if choice.device:
        raise StereoSfmError(f"{choice.spec} is a device: use 'stereo-sfm record {choice.spec}'")
    return to_place(options, choice, "convert")
