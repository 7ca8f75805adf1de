"""Vocabulary files (.npz, versioned) and the one that comes with the package."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from stereo_sfm.arrays import read_arrays
from stereo_sfm.config import LoopConfig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import read_bytes
from stereo_sfm.loop.vocabulary import Vocabulary

VERSION = 1  # of the file's format
_COLUMNS = ("centroids", "first_child", "child_count", "word", "idf")


def save_vocabulary(vocabulary: Vocabulary, path: Path) -> None:
    """Write a compressed npz; the same vocabulary gives the same bytes."""
    columns = {name: getattr(vocabulary, name) for name in _COLUMNS}
    with path.open("wb") as out:
        np.savez_compressed(out, version=np.array(VERSION), **columns)


def load_vocabulary(path: Path) -> Vocabulary:
    """Read what `save_vocabulary` wrote.

    Raises:
        StereoSfmError: no such file, not a vocabulary, or one of another version.
    """
    again = "train one with 'stereo-sfm vocabulary train'"
    try:
        data = read_arrays(read_bytes(path))
        version = int(data["version"])
        if version != VERSION:
            raise StereoSfmError(f"{path} is vocabulary version {version}, this program reads {VERSION}: {again}")
        columns = [data[name] for name in _COLUMNS]
    except FileNotFoundError:
        raise StereoSfmError(f"no vocabulary at {path}: {again}") from None
    except (KeyError, ValueError, TypeError, OSError):
        raise StereoSfmError(f"{path} is not a vocabulary file or is damaged: {again}") from None
    return Vocabulary(*columns)


def default_vocabulary() -> Vocabulary:
    """The vocabulary that comes with the package, trained on the simulated store."""
    with as_file(files("stereo_sfm") / "data" / "vocabulary.npz") as path:
        return load_vocabulary(path)


def configured_vocabulary(config: LoopConfig) -> Vocabulary:
    """The file that the configuration names, else the one of the package."""
    return load_vocabulary(Path(config.vocabulary)) if config.vocabulary else default_vocabulary()
