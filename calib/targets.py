"""Calibration targets: their corners in metres and their detection in images, by corner number."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm.errors import StereoSfmError, one_of
from stereo_sfm.types import F64, I64, U8

KINDS = ("checkerboard", "charuco", "aprilgrid")


@dataclass(frozen=True, eq=False)
class Detection:
    """The corners detected in one image."""

    ids: I64  # (K,) ascending
    uv: F64  # (K, 2) px

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class Target:
    """A flat target.

    checkerboard: `columns` x `rows` inner corners, `size` metres between them.
    charuco: `columns` x `rows` squares of `size` metres with markers of `size * ratio` metres.
    aprilgrid: `columns` x `rows` tags of `size` metres with gaps of `size * ratio` metres, as in Kalibr.
    """

    kind: str
    columns: int
    rows: int
    size: float
    ratio: float = 0.75
    dictionary: str = "DICT_4X4_50"

    def __post_init__(self) -> None:
        one_of(self.kind, KINDS, "target")
        if min(self.columns, self.rows) < 2 or not 0.001 < self.size < 2 or not 0.05 < self.ratio < 1:
            raise StereoSfmError(
                "invalid target: at least 2 x 2 elements, a size in metres and a ratio below one are required"
            )

    @property
    def points(self) -> F64:
        """(N, 3) corners in metres on the plane z = 0, by corner number."""
        if self.kind == "aprilgrid":
            pitch = self.size * (1 + self.ratio)
            corners = self.size * np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
            origins = np.stack(np.meshgrid(np.arange(self.columns), np.arange(self.rows)), -1).reshape(-1, 1, 2)
            xy = (pitch * origins + corners).reshape(-1, 2)
        else:
            inner = 1 if self.kind == "charuco" else 0
            grid = np.meshgrid(np.arange(self.columns - inner), np.arange(self.rows - inner))
            xy = (np.stack(grid, -1).reshape(-1, 2) + inner) * self.size
        return np.column_stack([np.asarray(xy, float), np.zeros(len(xy))]).astype(float)

    def detect(self, image: U8) -> Detection:
        """Corners of the target in a grey image; empty when it is not found."""
        found = {"checkerboard": _checkerboard, "charuco": _charuco, "aprilgrid": _aprilgrid}[self.kind](self, image)
        order = np.argsort(found.ids, kind="stable")
        return Detection(found.ids[order], found.uv[order])


def read_target(path: Path) -> Target:
    """A target file with Kalibr's keys (target_type, tagCols, ...) or those of `Target`."""
    from stereo_sfm.calib.formats.common import read_yaml, reading

    with reading(path, "target"):
        data = read_yaml(path)
        kind = data.get("target_type", data.get("kind"))
        if kind == "aprilgrid" and "tagCols" in data:
            sizes = float(data["tagSize"]), float(data["tagSpacing"])
            return Target(kind, int(data["tagCols"]), int(data["tagRows"]), *sizes)
        if kind == "checkerboard" and "targetCols" in data:
            return Target(kind, int(data["targetCols"]), int(data["targetRows"]), float(data["colSpacingMeters"]))
        return Target(
            str(kind), int(data["columns"]), int(data["rows"]), float(data["size"]), float(data.get("ratio", 0.75)),
            str(data.get("dictionary", "DICT_4X4_50")),
        )  # fmt: skip


def _empty() -> Detection:
    return Detection(np.zeros(0, np.int64), np.zeros((0, 2)))


def _checkerboard(target: Target, image: U8) -> Detection:
    import cv2

    size = (target.columns, target.rows)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    ok, corners = cv2.findChessboardCornersSB(image, size, flags=flags)
    if not ok:
        ok, corners = cv2.findChessboardCorners(
            image, size, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        )
        if not ok:
            return _empty()
        corners = np.asarray(corners, np.float32)
    uv = np.asarray(corners, float).reshape(-1, 2)
    spacing = np.linalg.norm(np.diff(uv.reshape(*size[::-1], 2), axis=1), axis=-1)
    uv = refine(image, uv, 0.3 * float(np.median(spacing)))
    return Detection(np.arange(len(uv)), uv)


def _charuco(target: Target, image: U8) -> Detection:
    import cv2

    board = charuco_board(target)
    corners: Any
    ids: Any
    corners, ids, marker_corners, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
    if ids is None or len(ids) < 4:
        return _empty()
    uv = np.asarray(corners, float).reshape(-1, 2)
    sides: Any = np.concatenate([np.linalg.norm(np.diff(np.asarray(c)[0], axis=0), axis=1) for c in marker_corners])
    return Detection(
        np.asarray(ids).ravel().astype(np.int64),
        refine(image, uv, float(np.median(sides)) * 0.5 * (1 / target.ratio - 1)),
    )


def charuco_board(target: Target) -> Any:
    """OpenCV's board of a charuco target."""
    import cv2

    code = getattr(cv2.aruco, target.dictionary, None)
    if code is None:
        raise StereoSfmError(
            f"unknown marker dictionary '{target.dictionary}' (use a name of OpenCV, such as DICT_5X5_100)"
        )
    dictionary = cv2.aruco.getPredefinedDictionary(code)
    squares = (target.columns, target.rows)
    return cv2.aruco.CharucoBoard(squares, target.size, target.size * target.ratio, dictionary)


def _aprilgrid(target: Target, image: U8) -> Detection:
    """Tags of family 36h11 with a border of two bits; number 4 * tag + corner, corners from bottom left, anticlockwise.

    The gaps' small black squares make every tag corner a saddle, which is refined.
    """
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = 2
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    parameters.adaptiveThreshWinSizeMax = 53
    parameters.minMarkerPerimeterRate = 0.02
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    tags: Any
    corners, tags, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    ids: list[int] = []
    uv: list[F64] = []
    for tag, quad in sorted(zip([] if tags is None else tags.ravel(), corners, strict=True), key=lambda c: int(c[0])):
        if tag >= target.columns * target.rows:
            continue
        points = np.asarray(quad, float)[0]
        side = float(np.linalg.norm(np.diff(points, axis=0), axis=1).min())
        refined = refine(image, points, 0.5 * side * target.ratio)
        if np.abs(refined - points).max() > max(2.5, 0.12 * side):
            continue
        # Kalibr: bottom left, bottom right, top right, top left. OpenCV: clockwise from Kalibr's second.
        order = [1, 0, 3, 2]
        ids.extend(4 * int(tag) + k for k in range(4))
        uv.extend(refined[order])
    return Detection(np.array(ids, np.int64), np.array(uv)) if len(ids) >= 8 else _empty()


def refine(image: U8, uv: F64, clear: float) -> F64:
    """(K, 2) saddle points near the guesses, in windows that stay within the `clear` px around a corner."""
    import cv2

    half = int(np.clip(0.8 * clear, 2, 8))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    out = cv2.cornerSubPix(image, uv.astype(np.float32).reshape(-1, 1, 2), (half, half), (-1, -1), criteria)
    return np.asarray(out, float).reshape(-1, 2)
