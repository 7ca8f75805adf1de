"""`stereo-sfm vocabulary`: train or describe a vocabulary."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import typed

if TYPE_CHECKING:
    from stereo_sfm.types import U8

# The training data of the package's vocabulary: `stereo-sfm vocabulary train -o FILE` reproduces it.
DEFAULT_SOURCES = tuple(f"sim:{scene}?people=0&seed={seed}" for seed in (101, 102) for scene in ("loop", "big"))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    train = actions.add_parser("train", help="train a vocabulary on the images of some sources")
    train.add_argument(
        "sources",
        nargs="*",
        default=list(DEFAULT_SOURCES),
        metavar="SOURCE",
        help="training data (default: that of the package's vocabulary)",
    )
    train.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="vocabulary file (.npz)")
    train.add_argument("--overwrite", action="store_true", help="replace an existing file")
    train.add_argument(
        "--images",
        type=int,
        default=80,
        metavar="N",
        help="images of each source, evenly spread (default: %(default)s)",
    )
    train.add_argument("--branching", type=int, default=10, help="children of each node of the tree")
    train.add_argument("--depth", type=int, default=4, help="levels of the tree")
    train.add_argument("--seed", type=int, default=0, help="random seed of the clustering")
    info = actions.add_parser("info", help="describe a vocabulary")
    info.add_argument("file", nargs="?", type=Path, help="vocabulary file (default: the one in the package)")


@dataclass(frozen=True)
class TrainOptions:
    """Options of `vocabulary train`, as the parser names them."""

    sources: list[str]
    output: Path
    overwrite: bool
    images: int
    branching: int
    depth: int
    seed: int


def run(args: argparse.Namespace) -> int:
    """Train or describe."""
    from stereo_sfm.loop.vocabulary_file import default_vocabulary, load_vocabulary

    if args.action == "train":
        _train(typed(TrainOptions, args))
        return 0
    vocabulary = load_vocabulary(args.file) if args.file else default_vocabulary()
    print(f"{len(vocabulary)} words in {len(vocabulary.word)} nodes, id {vocabulary.id}")
    return 0


def _check(options: TrainOptions) -> None:
    from stereo_sfm.errors import StereoSfmError

    for option, value, least in (
        ("--images", options.images, 1),
        ("--branching", options.branching, 2),
        ("--depth", options.depth, 1),
        ("--seed", options.seed, 0),
    ):
        if value < least:
            raise StereoSfmError(f"{option} must be at least {least}, not {value}")
    if options.output.exists() and not options.overwrite:
        raise StereoSfmError(f"{options.output} exists: choose another name or give --overwrite")


def _train(options: TrainOptions) -> None:
    from stereo_sfm.errors import StereoSfmError
    from stereo_sfm.loop.vocabulary import train
    from stereo_sfm.loop.vocabulary_file import save_vocabulary

    _check(options)
    images = [d for source in options.sources for d in _descriptors(source, options.images)]
    if not images:
        raise StereoSfmError("the sources contain no image with enough texture for training")
    vocabulary = train(images, options.branching, options.depth, options.seed)
    save_vocabulary(vocabulary, options.output)
    count = sum(len(d) for d in images)
    made = f"{len(vocabulary)} words from {count} descriptors of {len(images)} images"
    print(f"{made}, id {vocabulary.id}: {options.output}")


def spread(count: int, wanted: int) -> list[int]:
    """Which of `count` images to take."""
    return [k * count // min(wanted, count) for k in range(min(wanted, count))]


def _descriptors(spec: str, wanted: int) -> Iterator[U8]:
    """(N, 32) of images evenly spread over a source, or of its first images if their number is unknown."""
    from stereo_sfm.drivers.source import open_source
    from stereo_sfm.maps.single_image import still_keyframe

    with open_source(spec) as source:
        for image in source.at(spread(source.frame_count or wanted, wanted)):
            keyframe = still_keyframe(image, source.rig)
            if keyframe is not None:
                yield keyframe.corners.descriptors
