"""Camera models: `project(points) -> pixels` and `unproject(pixels) -> unit bearings`, vectorised over (..., 3).

Pinhole with radial-tangential, rational or tilted distortion as in OpenCV, Kannala-Brandt with four coefficients (PAMI
28, 2006, equation 6; the same as cv2.fisheye), the wide models of `lens_kernels`, and the epipolar-aligned wide
projection that rectification produces. NaN outside the range where a model is monotonic.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from stereo_sfm.geometry import kernels, lens_kernels
from stereo_sfm.geometry.lens_kernels import MORE, PARAMS, TILT
from stereo_sfm.types import F64, Bool, ReadOnly

LIMITS = 16  # kept ranges of models: corrections of a rig make cameras whose lenses differ in nothing but focal length
RADII, RADII_AT_ONCE = np.linspace(0, 20, 40001), 2000  # normalised radii tried, and so many before looking


@dataclass(frozen=True, eq=False)
class Camera(ReadOnly):
    """One camera: image size in pixels, focal lengths and principal point in pixels, distortion coefficients.

    The focal length is that of the image's centre, pixels per radian, for all models: some are published with another
    one (`published`).
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    params: F64 = field(init=False, repr=False)  # (PARAMS,) in the layout of geometry.kernels

    model: ClassVar[str] = ""
    model_id: ClassVar[int] = -1
    coefficients: ClassVar[tuple[str, ...]] = ()  # names of the distortion's
    slots: ClassVar[tuple[int, ...]] = tuple(range(4, 12))  # where they are in the parameters

    def __post_init__(self) -> None:
        if len(self.distortion) > len(self.coefficients):
            raise ValueError(f"{self.model} has at most {len(self.coefficients)} distortion coefficients")
        p = np.zeros(PARAMS)
        p[:4] = self.fx, self.fy, self.cx, self.cy
        p[:2] *= self._gain(self.distortion)
        p[list(self.slots[: len(self.distortion)])] = self.distortion
        self._derive(p)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # coefficients that no lens has
            p[kernels.LIMIT] = self._limit(tuple(p[4:12].tolist()))
        p.flags.writeable = False
        object.__setattr__(self, "distortion", tuple(float(d) for d in self.distortion))
        object.__setattr__(self, "params", p)

    def _limit(self, coefficients: tuple[float, ...]) -> float:
        return 0.0

    @classmethod
    def _gain(cls, distortion: tuple[float, ...]) -> float:
        """The focal length of the model's publication over that of the centre."""
        return 1.0

    @classmethod
    def published(
        cls, width: int, height: int, fx: float, fy: float, cx: float, cy: float, distortion: tuple[float, ...] = ()
    ) -> Self:
        """The camera with focal lengths as the model's publication and other programs have them.

        Raises:
            ZeroDivisionError: coefficients of no lens.
        """
        gain = cls._gain(distortion)
        return cls(width, height, fx / gain, fy / gain, cx, cy, distortion)

    @property
    def published_focal(self) -> tuple[float, float]:
        """(fx, fy) as `published` takes them."""
        gain = self._gain(self.distortion)
        return self.fx * gain, self.fy * gain

    def _derive(self, p: F64) -> None:
        """Fill in parameters that follow from the coefficients."""

    def impossible(self) -> str:
        """The coefficient that no lens of this model has, "" where all may be."""
        return ""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) px."""
        return self.width, self.height

    @property
    def matrix(self) -> F64:
        """(3, 3) K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def project(self, points: F64) -> F64:
        """Points (..., 3) in this camera -> (..., 2) px; NaN outside the range of the model."""
        points = np.asarray(points, float)
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        return kernels.project_many(self.model_id, self.params, flat).reshape(*points.shape[:-1], 2)

    def project_jacobian(self, points: F64) -> tuple[F64, F64]:
        """As `project`, with the derivative (..., 2, 3) of the pixel by the point."""
        points = np.asarray(points, float)
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        uv, jac = kernels.project_many_jacobian(self.model_id, self.params, flat)
        return uv.reshape(*points.shape[:-1], 2), jac.reshape(*points.shape[:-1], 2, 3)

    def unproject(self, uv: F64) -> F64:
        """Pixels (..., 2) -> unit bearings (..., 3); NaN where the model is not invertible."""
        uv = np.asarray(uv, float)
        flat = np.ascontiguousarray(uv.reshape(-1, 2))
        return kernels.unproject_many(self.model_id, self.params, flat).reshape(*uv.shape[:-1], 3)

    def inside(self, uv: F64, border: float = 0.0) -> Bool:
        """(..., 2) px -> whether the pixel is in the image, at least `border` px from the edge; False for NaN."""
        u, v = uv[..., 0], uv[..., 1]
        return (u >= border) & (v >= border) & (u <= self.width - 1 - border) & (v <= self.height - 1 - border)

    def bearing_grid(self, step: int = 1) -> F64:
        """(H, W, 3) unit bearing of every `step`-th pixel in both directions, NaN where there is none."""
        u, v = np.meshgrid(np.arange(0, self.width, step, dtype=float), np.arange(0, self.height, step, dtype=float))
        return self.unproject(np.stack([u, v], -1))

    def valid_mask(self, max_angle: float = np.pi, step: int = 1) -> Bool:
        """(H, W): every `step`-th pixel, whether its bearing is at most `max_angle` radians from the optical axis."""
        z = self.bearing_grid(step)[..., 2]
        return np.nan_to_num(z, nan=-2.0) >= np.cos(max_angle)


@functools.lru_cache(LIMITS)
def _growing_radius(coefficients: tuple[float, ...]) -> float:
    """Largest squared normalised radius up to which the radial part grows, 0 if it always does (up to 20)."""
    k1, k2, _, _, k3, k4, k5, k6 = coefficients
    if min(k1, k2, k3) >= 0 and not (k4 or k5 or k6):
        return 0.0
    for first in range(0, len(RADII) - 1, RADII_AT_ONCE):
        r = RADII[first : first + RADII_AT_ONCE + 1]
        r2 = r * r
        distorted = r * (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        falling = np.flatnonzero(np.diff(distorted) <= 0)
        if len(falling):
            return float(RADII[max(first + falling[0], 1)] ** 2)
    return 0.0


@functools.lru_cache(LIMITS)
def _growing_angle(coefficients: tuple[float, ...]) -> float:
    """Largest angle from the axis up to which the radius grows."""
    theta = np.linspace(0, np.pi, 20001)
    t2 = theta * theta
    k1, k2, k3, k4, *_ = coefficients
    slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    falling = np.flatnonzero(slope <= 1e-6)
    return float(theta[max(falling[0] - 1, 0)]) if len(falling) else float(np.pi)


@dataclass(frozen=True, eq=False)
class Pinhole(Camera):
    """Ideal pinhole."""

    model: ClassVar[str] = "pinhole"
    model_id: ClassVar[int] = kernels.PINHOLE


@dataclass(frozen=True, eq=False)
class RadTan(Camera):
    """Pinhole with OpenCV's distortion: k1 k2 p1 p2 [k3 [k4 k5 k6]] (radial-tangential or rational)."""

    model: ClassVar[str] = "radtan"
    model_id: ClassVar[int] = kernels.RADTAN
    coefficients: ClassVar[tuple[str, ...]] = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")

    def _limit(self, coefficients: tuple[float, ...]) -> float:
        return _growing_radius(coefficients)


@dataclass(frozen=True, eq=False)
class KannalaBrandt(Camera):
    """Fisheye: radius = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)."""

    model: ClassVar[str] = "kannala_brandt"
    model_id: ClassVar[int] = kernels.KANNALA_BRANDT
    coefficients: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "k4")

    def _limit(self, coefficients: tuple[float, ...]) -> float:
        return _growing_angle(coefficients)


@dataclass(frozen=True, eq=False)
class Epipolar(Camera):
    """Wide rectified projection: u = fx * longitude + cx along the baseline, v = fy * angle of the epipolar plane + cy.

    If both cameras are rotated so that the baseline is their x axis, equal rows of both images lie in one epipolar
    plane, for any field of view below 180 degrees.
    """

    model: ClassVar[str] = "epipolar"
    model_id: ClassVar[int] = kernels.EPIPOLAR


@dataclass(frozen=True, eq=False)
class Tilted(RadTan):
    """OpenCV's 14 coefficients: the rational model, a thin prism's s1 s2 s3 s4, and the sensor's tilt in radians."""

    model: ClassVar[str] = "tilted"
    model_id: ClassVar[int] = lens_kernels.TILTED
    coefficients: ClassVar[tuple[str, ...]] = (*RadTan.coefficients, "s1", "s2", "s3", "s4", "tau_x", "tau_y")
    slots: ClassVar[tuple[int, ...]] = (*RadTan.slots, *range(MORE, MORE + 6))

    def _derive(self, p: F64) -> None:
        p[TILT : TILT + 9] = _tilt(*p[MORE + 4 : MORE + 6].tolist()).ravel()

    def impossible(self) -> str:
        return "".join(f"tilt {tau:g}" for tau in self.distortion[12:] if not abs(tau) < 1)


@dataclass(frozen=True, eq=False)
class Fov(Camera):
    """One coefficient: radius = atan(2 r tan(w / 2)) / w of the pinhole's r (Kalibr's fov, COLMAP's FOV)."""

    model: ClassVar[str] = "fov"
    model_id: ClassVar[int] = lens_kernels.FOV
    coefficients: ClassVar[tuple[str, ...]] = ("w",)
    slots: ClassVar[tuple[int, ...]] = (MORE,)

    @classmethod
    def _gain(cls, distortion: tuple[float, ...]) -> float:
        w = distortion[0] if distortion else 0.0
        return w / (2 * float(np.tan(0.5 * w))) if w else 1.0

    def impossible(self) -> str:
        return "" if 0 < self.params[MORE] < np.pi else f"w {self.params[MORE]:g}"


@dataclass(frozen=True, eq=False)
class Mei(Camera):
    """Unified sphere with xi, then k1 k2 p1 p2 (Kalibr's omni, VINS's MEI, cv2.omnidir)."""

    model: ClassVar[str] = "mei"
    model_id: ClassVar[int] = lens_kernels.MEI
    coefficients: ClassVar[tuple[str, ...]] = ("xi", "k1", "k2", "p1", "p2")
    slots: ClassVar[tuple[int, ...]] = (MORE, 4, 5, 6, 7)

    @classmethod
    def _gain(cls, distortion: tuple[float, ...]) -> float:
        return 1.0 + distortion[0] if distortion else 1.0

    def _limit(self, coefficients: tuple[float, ...]) -> float:
        return _growing_radius(coefficients)

    def impossible(self) -> str:
        return "" if self.params[MORE] > -1 else f"xi {self.params[MORE]:g}"


@dataclass(frozen=True, eq=False)
class DoubleSphere(Camera):
    """Two spheres: xi alpha (Kalibr's and Basalt's ds)."""

    model: ClassVar[str] = "double_sphere"
    model_id: ClassVar[int] = lens_kernels.DOUBLE_SPHERE
    coefficients: ClassVar[tuple[str, ...]] = ("xi", "alpha")
    slots: ClassVar[tuple[int, ...]] = (MORE, MORE + 1)

    @classmethod
    def _gain(cls, distortion: tuple[float, ...]) -> float:
        return 1.0 + distortion[0] if distortion else 1.0

    def impossible(self) -> str:
        xi, alpha = self.params[MORE : MORE + 2].tolist()
        return "" if -1 < xi <= 1 and 0 <= alpha < 1 else f"xi {xi:g}, alpha {alpha:g}"


@dataclass(frozen=True, eq=False)
class Eucm(Camera):
    """Extended unified camera model: alpha beta (Kalibr's and Basalt's eucm; Basalt's ucm has beta 1)."""

    model: ClassVar[str] = "eucm"
    model_id: ClassVar[int] = lens_kernels.EUCM
    coefficients: ClassVar[tuple[str, ...]] = ("alpha", "beta")
    slots: ClassVar[tuple[int, ...]] = (MORE, MORE + 1)

    def impossible(self) -> str:
        alpha, beta = self.params[MORE : MORE + 2].tolist()
        return "" if 0 <= alpha < 1 and beta > 0 else f"alpha {alpha:g}, beta {beta:g}"


def _tilt(tau_x: float, tau_y: float) -> F64:
    """(3, 3) from the lens's plane to the tilted sensor's, as OpenCV's computeTiltProjectionMatrix."""
    (cx, sx), (cy, sy) = ((np.cos(tau), np.sin(tau)) for tau in (tau_x, tau_y))
    turn = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    return np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1]]) @ turn


_ALL = (Pinhole, RadTan, KannalaBrandt, Epipolar, Tilted, Fov, Mei, DoubleSphere, Eucm)
MODELS: dict[str, type[Camera]] = {c.model: c for c in _ALL}
