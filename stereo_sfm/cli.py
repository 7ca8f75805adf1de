"""The `stereo-sfm` command: a table of subcommands, each in its own file under `commands/`, imported when called."""

from __future__ import annotations

import argparse
import atexit
import importlib
import io
import logging
import os
import select
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NoReturn

from stereo_sfm.commands._stop import INTERRUPTED
from stereo_sfm.errors import StereoSfmError, did_you_mean, from_os_error

# subcommand -> what `--help` says; the code is in stereo_sfm/commands/<name with _ for ->.py
COMMANDS: dict[str, str] = {
    "run": "turn a source into a trajectory and a map",
    "replay": "repeat a run from its log, bit for bit",
    "viz": "show a run, a saved map or a recording in rerun",
    "batch": "run many recordings, on this machine or on a cluster",
    "fleet": "map the walks of many stores each night, in a bucket and on a cluster",
    "serve": "run continuously on a robot: publish poses, keep the map up to date, limit the size of recordings",
    "service": "install the service on this computer, remove it, or show its state",
    "record": "write a source to an MCAP file",
    "info": "describe a recording or dataset folder and its problems",
    "convert": "convert a dataset folder to MCAP",
    "recover": "repair a recording that was cut off",
    "diff": "compare two logs and show where they first differ",
    "rectify": "write rectified image pairs with epipolar lines for inspection",
    "calibrate": "calibrate a stereo rig from images of a target",
    "check-calib": "check a calibration on any recording, without a target",
    "mask": "make masks of the image parts that show the robot itself or nothing",
    "convert-calib": "convert a calibration between the formats of Kalibr, ROS, OpenCV, COLMAP, EuRoC and others",
    "map": "describe, merge, prune and export saved maps",
    "export": "export a run or a map to the formats of other programs",
    "dense": "make a mesh, a cloud and a costmap from the images of a run or a map",
    "vocabulary": "train or describe the vocabulary of place recognition",
    "ablation": "compare the features, estimators and modules of the papers",
    "eval": "compare a trajectory with ground truth",
    "compare": "show several runs on one page: trajectories, errors, times",
    "sources": "list the kinds of cameras and datasets that can be opened, and their options",
    "devices": "list the attached cameras",
    "t265": "install or check the firmware of a T265, or reset the camera",
    "udev": "print udev rules for using the cameras without root (Linux)",
    "config": "show the resolved configuration",
    "compile": "compile the numerical kernels now, so that the first run starts at once",
}


class _Parser(argparse.ArgumentParser):
    """Suggests the nearest known word for an unknown value or option."""

    def _check_value(self, action: argparse.Action, value: object) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            if error.message and action.choices is not None:
                error.message += did_you_mean(str(value), map(str, action.choices))
            raise

    def error(self, message: str) -> NoReturn:
        unknown = message.partition("unrecognized arguments: ")[2].partition(" ")[0].partition("=")[0]
        options = [name for parser in self._all() for name in parser._option_string_actions]  # pyright: ignore[reportPrivateUsage]
        super().error(message + (did_you_mean(unknown, options) if unknown else ""))

    def _all(self) -> Iterator[argparse.ArgumentParser]:
        """This parser and those of the commands below it."""
        yield self
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):  # pyright: ignore[reportPrivateUsage]
                yield from action.choices.values()


def _build_parser(chosen: str | None) -> argparse.ArgumentParser:
    parser = _Parser(
        prog="stereo-sfm",
        description="Visual structure-from-motion and SLAM for stereo cameras in retail stores.",
    )
    parser.add_argument(
        "--version",
        dest="print_versions",  # `map release` has a version of its own
        action="store_true",
        help="print the versions of this package and its dependencies",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for name, text in COMMANDS.items():
        sub = commands.add_parser(name, help=text, description=text)
        if name == chosen:
            importlib.import_module(f"stereo_sfm.commands.{name.replace('-', '_')}").add_arguments(sub)
    return parser


def _print_versions() -> None:
    from stereo_sfm.log.provenance import versions

    print(versions(), end="")


class _Standard(logging.Handler):
    """Prints each message as one line on the current standard error."""

    def emit(self, record: logging.LogRecord) -> None:
        print(f"{record.levelname.lower()}: {record.getMessage()}", file=sys.stderr)


def _start_logging(options: argparse.Namespace) -> None:
    log = logging.getLogger("stereo_sfm")
    verbose, quiet = getattr(options, "verbose", False), getattr(options, "quiet", False)
    screen = _Standard(logging.INFO if verbose else logging.ERROR if quiet else logging.WARNING)
    log.handlers = [screen]
    log.propagate = False
    log.setLevel(logging.INFO)  # the log of a run also holds what is not printed


def _repair_standard_streams() -> None:
    """Open closed streams on the null device; replace characters that the terminal cannot show."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
            setattr(sys, name, open(number, "r" if number == 0 else "w"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _output_closed() -> bool:
    """Whether the reader of standard output has closed it (`| head`), which is no error."""
    reader = select.poll()
    reader.register(sys.stdout.fileno(), 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in reader.poll(0))


def _fetched(value: object) -> object:
    """An argument; what a command reads as a copy, where it is in a bucket.

    Raises:
        StereoSfmError: it cannot be fetched, or is not what a command reads: the folder `s3:` would be made of it. It
            is a pipe, which would hold up who opens it.
    """
    if not isinstance(value, Path):
        return value
    from stereo_sfm.input_file import refuse_pipe
    from stereo_sfm.storage.remote import InputPath, of_path

    found = of_path(value)
    if isinstance(found, Path):
        refuse_pipe(found)
        return found
    if not isinstance(value, InputPath):
        raise StereoSfmError(f"{found} cannot be here, only a path ('stereo-sfm fleet upload' sends a folder)")
    from stereo_sfm.fleet.copies import fetched

    return fetched(found)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point.

    Exit codes: 0 ok, 1 internal error, 2 bad input, 3 check failed, 4 tracking failed, 130 interrupted.
    """
    if argv is None:
        _repair_standard_streams()
    args = list(sys.argv[1:] if argv is None else argv)
    chosen = next((a for a in args if a in COMMANDS), None)
    parser = _build_parser(chosen)
    options = parser.parse_args(args)
    _start_logging(options)
    try:
        if options.print_versions:
            _print_versions()
            return 0
        if options.command is None:
            parser.print_help()
            return 0
        for name, value in vars(options).items():
            setattr(options, name, [*map(_fetched, value)] if isinstance(value, list) else _fetched(value))
        command = importlib.import_module(f"stereo_sfm.commands.{options.command.replace('-', '_')}")
        code = command.run(options)
        if argv is None and options.command == "serve":
            _leave(code)
        return code
    except StereoSfmError as error:
        print(f"stereo-sfm {options.command}: {error}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:
        if not _output_closed():
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        known = from_os_error(error)
        if known is None:
            raise
        print(f"stereo-sfm {options.command}: {known}", file=sys.stderr)
        return known.exit_code
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED


def _leave(code: int) -> None:
    """End a process whose work is written: the interpreter would take seconds on a busy computer to free its memory."""
    atexit._run_exitfuncs()  # pyright: ignore[reportPrivateUsage]
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    sys.exit(main())
