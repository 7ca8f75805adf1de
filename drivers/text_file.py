"""Text files of datasets."""

from __future__ import annotations

from pathlib import Path

from stereo_sfm.errors import StereoSfmError


def read_text(path: Path) -> str:
    """The text of a file in UTF-8, with or without a byte order mark.

    Raises:
        OSError: it cannot be read.
        StereoSfmError: it is in another encoding.
    """
    try:
        return path.read_text("utf-8-sig")
    except UnicodeDecodeError:
        raise StereoSfmError(f"{path} is not text in UTF-8: save it in that encoding") from None
