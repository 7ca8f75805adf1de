"""What all dataset folders share: a list of image files with stamps, a rig, and ground truth where there is one."""

from __future__ import annotations

import logging
import string
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np

from calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import F32, U8, StereoImage, Trajectory

log = logging.getLogger("stereo_sfm")

SHOWN_WARNINGS = 5  # of unreadable images, one by one; then only their number
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")


@dataclass(frozen=True)
class Shot:
    """The files of one frame."""

    stamp_ns: int
    left: Path
    right: Path | None = None
    depth: Path | None = None
    exposure_us: float = float("nan")


class UnreadableImage(Exception):
    """A file that is missing or that OpenCV cannot decode: the frame is dropped, the run goes on."""


def read_gray(path: Path) -> U8:
    """One image as (H, W) u8. Sixteen-bit files keep their upper eight bits.

    TUM VI stores the sensor's twelve bits in the upper part of sixteen, so full white stays full white.
    """
    image = cv2.imread(str(path), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if image is None:
        raise UnreadableImage(str(path))
    if image.dtype == np.uint16:
        return np.right_shift(image, 8).astype(np.uint8)
    if image.dtype != np.uint8:
        raise UnreadableImage(f"{path} ({image.dtype} pixels)")
    return image.astype(np.uint8, copy=False)


def read_depth(path: Path, scale: float) -> F32:
    """A sixteen-bit depth image as (H, W) f32 metres, NaN where it holds 0.

    Args:
        path: the file.
        scale: stored units a metre.
    """
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if image is None or image.ndim != 2:
        raise UnreadableImage(str(path))
    depth = image.astype(np.float32)
    depth[depth == 0] = np.nan
    depth /= np.float32(scale)
    return depth


class FolderSource:
    """Frames from files, in stamp order. A frame with an unreadable file is dropped with a warning and counted."""

    live: bool = False

    def __init__(
        self,
        name: str,
        rig: Rig,
        shots: Sequence[Shot],
        ground_truth: Trajectory | None = None,
        depth_scale: float = 5000.0,
    ) -> None:
        if not shots:
            raise StereoSfmError(f"{name}: no images")
        self.name = name
        self.rig = rig
        self.ground_truth: Trajectory | None = ground_truth
        self.shots = sorted(shots, key=lambda shot: shot.stamp_ns)
        self.depth_scale = depth_scale
        self.frame_count: int | None = len(self.shots)
        self._check_first()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def __iter__(self) -> Iterator[StereoImage]:
        dropped, read, unreadable = 0, 0, 0
        for frame_id, shot in enumerate(self.shots):
            try:
                image = self._read(frame_id, shot, dropped)
            except UnreadableImage as error:
                dropped += 1
                unreadable += 1
                if unreadable <= SHOWN_WARNINGS:
                    log.warning("%s: cannot read %s, frame %d is dropped", self.name, error, frame_id)
                continue
            dropped = 0
            read += 1
            yield image
        if unreadable > SHOWN_WARNINGS:
            log.warning("%s: %d frames could not be read", self.name, unreadable)
        if not read:
            raise StereoSfmError(f"{self.name}: none of the {len(self.shots)} images can be read")

    def _read(self, frame_id: int, shot: Shot, dropped: int) -> StereoImage:
        left = read_gray(shot.left)
        right = read_gray(shot.right) if shot.right is not None else None
        depth = read_depth(shot.depth, self.depth_scale) if shot.depth is not None else None
        self._check_size(shot.left, left, self.rig.left.size)
        if right is not None and self.rig.right is not None:
            self._check_size(shot.right, right, self.rig.right.size)
        if depth is not None:
            self._check_size(shot.depth, depth, self.rig.left.size)
        return StereoImage(
            frame_id,
            shot.stamp_ns,
            left,
            right,
            depth,
            exposure_us=shot.exposure_us,
            dropped_before=dropped,
        )

    def _check_first(self) -> None:
        """The images must fit the calibration, and that is said before the first frame."""
        try:
            self._read(0, self.shots[0], 0)
        except UnreadableImage:
            return

    def _check_size(self, path: Path | None, image: U8 | F32, size: tuple[int, int]) -> None:
        height, width = image.shape
        if (width, height) != size:
            raise StereoSfmError(
                f"{path} is {width}x{height} but the calibration is for {size[0]}x{size[1]}: "
                "use the calibration of these images (--rig FILE)"
            )


def list_images(folder: Path) -> list[Path]:
    """The image files of a folder in the order of their numbers (image2 before image10)."""
    if not folder.is_dir():
        raise StereoSfmError(f"no image folder {folder}")
    files = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES]
    if not files:
        raise StereoSfmError(f"no images in {folder}")
    return sorted(files, key=natural_key)


def natural_key(path: Path) -> tuple[tuple[int, str], ...]:
    """Sort key that compares runs of digits as numbers."""
    parts: list[tuple[int, str]] = []
    run = ""
    for character in path.stem + "\0":
        if run and run[-1].isdigit() != character.isdigit():
            parts.append((int(run), "") if run.isdigit() else (-1, run))
            run = ""
        run += character
    return (*parts, (-1, path.name))


def pair_in_order(name: str, left: list[Path], right: list[Path]) -> list[tuple[Path, Path]]:
    """Pair two lists by file name if the names agree, else by position; leaves out, with a warning, the rest."""
    partner = {_without_prefix(p): p for p in right}
    common = [(p, partner[_without_prefix(p)]) for p in left if _without_prefix(p) in partner]
    if not common:
        common = list(zip(left, right, strict=False))
    if len(common) < max(len(left), len(right)):
        log.warning("%s: %d left and %d right images, the %d pairs are used", name, len(left), len(right), len(common))
    return common


def stamps_of(name: str, images: list[Path], stamp_ns: list[int]) -> dict[Path, int]:
    """The stamps of numbered images that lie beside a list of stamps, one a line, as KITTI has them.

    Images and lines go together in order where there are as many, by the images' numbers where some are missing.
    """
    numbers = [int(p.stem) if p.stem.isdigit() else len(stamp_ns) for p in images]
    if len(images) == len(stamp_ns) or max(numbers) >= len(stamp_ns):
        if len(images) != len(stamp_ns):
            log.warning("%s: %d images but %d stamps, the common part is used", name, len(images), len(stamp_ns))
        return dict(zip(images, stamp_ns, strict=False))
    log.warning("%s: %d of %d images are missing", name, len(stamp_ns) - len(images), len(stamp_ns))
    return {image: stamp_ns[number] for image, number in zip(images, numbers, strict=True)}


def _without_prefix(path: Path) -> str:
    """left_0012 -> 0012, so that both eyes' files have one name."""
    return path.stem.lstrip(string.ascii_letters + "_-") or path.stem


def pair_by_stamp(a: Sequence[int], b: Sequence[int], max_difference_ns: int) -> list[tuple[int, int]]:
    """Indices (i, j) of the pairs whose stamps differ least; each entry is used once, smallest differences first."""
    if not a or not b:
        return []
    stamps_a, stamps_b = np.asarray(a, np.int64), np.asarray(b, np.int64)
    order = np.argsort(stamps_b, kind="stable")
    right_of = np.searchsorted(stamps_b[order], stamps_a)
    candidates: list[tuple[int, int, int]] = []
    for i, position in enumerate(right_of):
        for j in {max(position - 1, 0), min(position, len(order) - 1)}:
            difference = abs(int(stamps_a[i]) - int(stamps_b[order[j]]))
            if difference <= max_difference_ns:
                candidates.append((difference, i, int(order[j])))
    pairs: list[tuple[int, int]] = []
    used_a: set[int] = set()
    used_b: set[int] = set()
    for _, i, j in sorted(candidates):
        if i not in used_a and j not in used_b:
            used_a.add(i)
            used_b.add(j)
            pairs.append((i, j))
    return sorted(pairs)


def folder_of(name: str, path: str) -> Path:
    """The folder a user named.

    Raises:
        StereoSfmError: it does not exist.
    """
    folder = Path(path).expanduser()
    if not folder.is_dir():
        raise StereoSfmError(f"{name}: no folder {path or '(none given)'}")
    return folder


def need(path: Path, what: str) -> Path:
    """`path`, which must exist.

    Raises:
        StereoSfmError: it does not; `what` says what it is.
    """
    if not path.exists():
        raise StereoSfmError(f"no {what} at {path}")
    return path
