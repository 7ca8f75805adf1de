"""`stereo-sfm config dump`: the resolved configuration."""

from __future__ import annotations

import argparse

from stereo_sfm.commands._options import add_config_arguments, load_config


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument(
        "action", nargs="?", choices=("dump", "show"), default="dump", help="what to do (default: dump)"
    )
    add_config_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print every setting with its value and description, as TOML that `run -c` reads."""
    from stereo_sfm import config

    print(config.explain(load_config(args)), end="")
    return 0
