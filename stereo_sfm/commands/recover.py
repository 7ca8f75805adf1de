"""`stereo-sfm recover`: a repaired copy of a file that was not closed or is damaged."""

from __future__ import annotations

import argparse
from pathlib import Path

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.storage.remote import InputPath


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("input", type=InputPath, metavar="IN.mcap", help="the file to repair")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.mcap", help="file to write")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")


def run(args: argparse.Namespace) -> int:
    """Copy every whole record and write the index."""
    from stereo_sfm.log.repair import recover

    source, target = args.input, args.output
    if target.exists() and target.samefile(source):
        raise StereoSfmError("the repaired copy needs another name: the original is kept")
    try:
        found = recover(source, target, args.overwrite)
    except OSError as error:
        raise StereoSfmError(f"cannot recover {source} to {target}: {error.strerror}") from None
    first, last = found.time_range
    print(f"{target}: {found.messages} messages, {(last - first) / 1e9:.1f} s, {len(found.channels)} topics")
    if found.closed and not found.bad_chunks:
        print(f"{source} was complete: nothing had to be repaired")
        return 0
    lost = source.stat().st_size - found.end
    if not found.closed:
        print(f"{source} was not closed: the incomplete record in its last {lost} bytes is omitted")
    if found.bad_chunks:
        size = sum(span.length for span in found.bad_chunks)
        print(f"{len(found.bad_chunks)} damaged chunks ({size} bytes) are omitted")
    return 0
