"""The names of files and folders in object storage: `s3://BUCKET/KEY`, `gs://`, `az://`, `file:///PATH`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path, PosixPath
from urllib.parse import unquote

from stereo_sfm.errors import StereoSfmError, did_you_mean

SCHEMES = ("s3", "gs", "az", "file")
_BUCKET = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_COLLAPSED = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+:)/")
_URI = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://(.*)", re.DOTALL)


@dataclass(frozen=True)
class Remote:
    """A file or a folder in a bucket. `str` gives its URI, which holds no credentials."""

    scheme: str  # of SCHEMES
    bucket: str  # "" of file://
    key: str  # without slashes at its ends

    @staticmethod
    def of(uri: str) -> Remote:
        """Parse a URI.

        Raises:
            StereoSfmError: an unknown scheme, no bucket, or credentials in it, which are not printed.
        """
        found = _URI.fullmatch(uri)
        if found is None:
            raise StereoSfmError(f"'{uri}' is no address of a bucket: write s3://BUCKET/KEY")
        scheme, rest = found[1].lower(), found[2]
        if scheme not in SCHEMES:
            raise StereoSfmError(
                f"unknown scheme '{found[1]}://'{did_you_mean(scheme, SCHEMES)} "
                f"(choose one of {', '.join(f'{s}://' for s in SCHEMES)})"
            )
        bucket, _, key = rest.partition("/")
        if "@" in bucket:
            raise StereoSfmError(f"{scheme}:// takes no credentials in an address: set them in the environment")
        if scheme == "file":
            if bucket not in ("", "localhost"):
                raise StereoSfmError(f"file://{rest}: a path on this computer begins with three slashes: file:///PATH")
            return Remote(scheme, "", unquote(key).strip("/"))
        if not bucket:
            raise StereoSfmError(f"{uri} names no bucket: write {scheme}://BUCKET/KEY")
        if not _BUCKET.fullmatch(bucket):
            raise StereoSfmError(f"'{bucket}' is no name of a bucket: letters, digits, dots, '-' and '_'")
        key = key.strip("/")
        if key and {"", ".", ".."} & set(key.split("/")):
            raise StereoSfmError(f"{uri} has an empty name or dots between two slashes")
        return Remote(scheme, bucket, key)

    def __str__(self) -> str:
        return f"{self.scheme}://{self.bucket}/{self.key}"

    def __truediv__(self, name: str) -> Remote:
        return Remote(self.scheme, self.bucket, f"{self.key}/{name}".strip("/"))

    @property
    def name(self) -> str:
        """The last part of the key, or the bucket."""
        return self.key.rpartition("/")[2] or self.bucket

    @property
    def parent(self) -> Remote:
        """The folder it is in."""
        return Remote(self.scheme, self.bucket, self.key.rpartition("/")[0])

    @property
    def suffix(self) -> str:
        """Of the name, with its dot."""
        return Path(self.name).suffix


Place = Path | Remote


class InputPath(PosixPath):
    """The path of what a command reads: it may also be an address."""


def of_path(path: Path) -> Place:
    """What a path means that may be an address, which has lost one of its slashes: that, or a path.

    Raises:
        StereoSfmError: as `Remote.of`.
    """
    found = _COLLAPSED.match(str(path))
    if found is None or Path(found[1]).exists():
        return path
    slashes = "///" if found[1].lower() == "file:" else "//"
    return place(f"{found[1]}{slashes}{str(path)[found.end() :]}")


def is_uri(text: str) -> bool:
    """Whether a text is an address with a scheme, known or not."""
    return _URI.fullmatch(text) is not None


def place(text: str) -> Place:
    """A path, or the address of something in a bucket; `file://` is a path.

    Raises:
        StereoSfmError: as `Remote.of`, or the text is empty.
    """
    if not text:
        raise StereoSfmError("an empty text names no folder: write . for this one")
    if not is_uri(text):
        return Path(text)
    if "?" in text:  # in what somebody writes it begins a signature; an object may have it in its name
        raise StereoSfmError(
            f"{text.partition(':')[0]}://...: an address has no '?', and signatures have no place in it"
        )
    found = Remote.of(text)
    return Path("/") / found.key if found.scheme == "file" else found
