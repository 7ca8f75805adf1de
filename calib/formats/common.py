"""Shared by the readers and writers of all formats: one-line errors, lens models by coefficients, matrices."""

from __future__ import annotations

import json
import re
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from stereo_sfm import input_file
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera, Pinhole, RadTan, Tilted
from stereo_sfm.types import F64

MAX_FILE_BYTES = 4 << 20
MAX_YAML_CHARS = 512 << 10


@contextmanager
def reading(path: Path | str, file_format: str) -> Generator[None]:
    """Convert any error while a calibration is read into one line that names the file and the reason."""
    try:
        yield
    except StereoSfmError as error:
        if str(path) in str(error) or file_format in str(error):
            raise
        raise StereoSfmError(f"{file_format} calibration {path}: {error}") from None
    except FileNotFoundError as error:
        raise StereoSfmError(f"no {file_format} calibration: {error.filename or path} does not exist") from None
    except KeyError as error:
        raise StereoSfmError(f"{file_format} calibration {path}: key {error.args[0]!r} is missing") from None
    except (ValueError, TypeError, IndexError, ArithmeticError, AttributeError, RecursionError, OSError) as error:
        first_line = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise StereoSfmError(f"{file_format} calibration {path} is malformed: {first_line}") from None


def read_text(path: Path) -> str:
    """A calibration file's text.

    Raises:
        OSError: it cannot be read, or is larger than any calibration. UnicodeError: it is no text.
    """
    return input_file.read_text(path, MAX_FILE_BYTES)


def read_yaml(path: Path) -> dict[str, Any]:
    """`yaml_mapping` of a file."""
    return yaml_mapping(read_text(path))


def yaml_mapping(text: str) -> dict[str, Any]:
    """Keys and values of a YAML text; OpenCV's header `%YAML:1.0` and its matrices are supported.

    Raises:
        ValueError: the text is not YAML, not a mapping, or expands to more values than a calibration has.
    """
    import yaml

    from stereo_sfm.calib.formats.yaml_loader import CalibrationLoader

    if len(text) > MAX_YAML_CHARS:
        raise ValueError(f"larger than {MAX_YAML_CHARS >> 10} KiB, which no calibration is")
    try:
        data = yaml.load(re.sub(r"\A\s*%YAML:[0-9.]+[^\n]*\n", "", text), CalibrationLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        raise ValueError(f"not YAML{f' (line {mark.line + 1})' if mark else ''}") from None
    if not isinstance(data, dict):
        raise ValueError("expected a mapping of keys to values")
    return data


def read_json(path: Path) -> Any:
    """Any JSON value.

    Raises:
        ValueError: malformed, or nested too deeply.
    """
    try:
        return json.loads(read_text(path))
    except RecursionError:
        raise ValueError("nested too deeply") from None


def write_yaml(path: Path, data: dict[str, Any]) -> None:
    """Write `yaml_text` to a file."""
    path.write_text(yaml_text(data), encoding="utf-8")


def yaml_text(data: dict[str, Any]) -> str:
    """Keys in the order given, lists on one line, floats with all digits."""
    import yaml

    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=200)


def numbers(values: Any, count: int | None = None) -> list[float]:
    """A flat list of finite floats, of length `count` where given."""
    flat = np.asarray(values, float).ravel()
    if count is not None and len(flat) != count:
        raise ValueError(f"expected {count} numbers, found {len(flat)}")
    if not np.isfinite(flat).all():
        raise ValueError("a number is not finite")
    return [float(v) for v in flat]


def no_other_distortion(names: Iterable[str], wanted: str) -> None:
    """Raises ValueError where a file without `wanted` has a distortion of another name: the lens is not ideal."""
    other = [name for name in names if "dist" in name.lower() and name != "distortion_model"]
    if other:
        raise ValueError(f"the distortion is not called {wanted}, but {', '.join(other)}: rename it")


def rigid(values: Any, unit: float = 1.0) -> F64:
    """16 (or 12) numbers row by row -> (4, 4) with the rotation orthonormalized if it was rounded in the file.

    `unit`: of the translation, in metres.
    """
    ragged = isinstance(values, list) and len({len(row) if isinstance(row, list) else 0 for row in values}) > 1
    flat = np.zeros(0) if ragged else np.array(numbers(values))
    if len(flat) not in (12, 16):
        found = "rows of different lengths" if ragged else f"{len(flat)}"
        raise ValueError(f"a transform needs 4 rows of 4 numbers (or 12 or 16 in one row), found {found}")
    transform = np.eye(4)
    transform[:3] = flat[:12].reshape(3, 4)
    transform[:3, 3] *= unit
    return exact_rotation(transform)


def exact_rotation(transform: F64) -> F64:
    """(4, 4) with an orthonormal rotation; ValueError for a matrix that is not close to a rotation."""
    rotation = transform[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # 1e200 is no rotation's
        error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if not error <= 1e-3 or np.linalg.det(rotation) < 0:
        raise ValueError("a rotation matrix is not orthonormal")
    return se3.orthonormalize(transform) if error > 1e-14 else transform


def brown(
    size: Sequence[int], focal: Sequence[float], centre: Sequence[float], coefficients: Sequence[float]
) -> Camera:
    """Pinhole with OpenCV's coefficients k1 k2 p1 p2 [k3 [k4 k5 k6 [s1..s4 [tx ty]]]]; all zero is an ideal pinhole."""
    d = list(coefficients)
    while d and d[-1] == 0:
        d.pop()
    if len(d) > 14:
        raise ValueError(f"{len(d)} distortion coefficients: OpenCV has at most 14")
    args = int(size[0]), int(size[1]), float(focal[0]), float(focal[1]), float(centre[0]), float(centre[1])
    lens = Tilted if len(d) > 8 else RadTan
    return lens(*args, tuple(d)) if d else Pinhole(*args)


def padded(camera: Camera, count: int) -> list[float]:
    """The camera's coefficients, zero-padded to `count`."""
    return [*camera.distortion, *[0.0] * (count - len(camera.distortion))]


def rows(matrix: F64) -> list[list[float]]:
    """(R, C) as nested lists of floats."""
    return [[float(v) for v in row] for row in matrix]


def stereo_only(right: Camera | None, file_format: str) -> Camera:
    """The right camera, or an error for a format of stereo pairs only."""
    if right is None:
        raise StereoSfmError(f"{file_format} stores stereo pairs only: this rig has one camera")
    return right


def unsupported(camera: Camera, file_format: str) -> StereoSfmError:
    """The error for a lens model that a format cannot express."""
    return StereoSfmError(
        f"{file_format} has no lens model for '{camera.model}': rectify to pinhole first (in a run, --rectify pinhole) "
        "or use the format 'rig'"
    )


def pose_dict(a_T_b: F64) -> dict[str, float]:
    """Basalt's px py pz qx qy qz qw."""
    quaternion = se3.quaternion_from_rotation(a_T_b[:3, :3])
    return dict(zip(("px", "py", "pz", "qx", "qy", "qz", "qw"), map(float, [*a_T_b[:3, 3], *quaternion]), strict=True))
