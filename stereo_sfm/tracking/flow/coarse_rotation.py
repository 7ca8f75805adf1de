"""Rotation between two images by aligning their smallest pyramid levels, for motion faster than flow can follow.

A small blurred image, as in Klein & Murray, Improving the Agility of Keyframe-Based SLAM (ECCV 2008), section 3.4, here
for any camera model: every pixel is a bearing, turned and projected; brightness differences give the rotation.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.kernels import inlined, njit, project_one
from stereo_sfm.tracking.flow.klt import COARSE, Pyramid
from stereo_sfm.types import F64, I32, Bool

ITERATIONS = 12  # on each level, at most: an alignment that has not ended by then does not converge
SEARCHED = 0.25  # of the field of view: rotations to either side that are tried where no prediction holds
SPACING_PX = 2  # of the smallest level, from one of them to the next: the alignment reaches as far
COMPARED = 1000  # pixels of the smallest level by which they are compared


@inlined
def _turned(r, b, model, params):
    """A bearing (3,) turned by a rotation (3, 3), and its pixel with the derivatives."""
    x = r[0, 0] * b[0] + r[0, 1] * b[1] + r[0, 2] * b[2]
    y = r[1, 0] * b[0] + r[1, 1] * b[1] + r[1, 2] * b[2]
    z = r[2, 0] * b[0] + r[2, 1] * b[1] + r[2, 2] * b[2]
    return x, y, z, project_one(model, params, x, y, z)


@njit
def _normal_equations(prev, cur, bearings, stride, model, params, scale, rotation, offset):
    """(3, 3) and (3,) of the brightness differences by a left rotation increment, mean difference, count.

    `bearings`: (h, w, 3) of every `stride`-th pixel of a level of the previous image.
    """
    h, w = bearings.shape[:2]
    hc, wc = cur.shape
    normal = np.zeros((3, 3))
    rhs = np.zeros(3)
    total, count = 0.0, 0
    jac = np.zeros(3)
    for v in range(h):
        for u in range(w):
            if math.isnan(bearings[v, u, 0]):
                continue
            x, y, z, p = _turned(rotation, bearings[v, u], model, params)
            if math.isnan(p[0]):
                continue
            cu, cv = p[0] / scale, p[1] / scale
            if cu < 1 or cv < 1 or cu >= wc - 2 or cv >= hc - 2:
                continue
            iu, iv = int(cu), int(cv)
            fu, fv = cu - iu, cv - iv
            i00, i01 = float(cur[iv, iu]), float(cur[iv, iu + 1])
            i10, i11 = float(cur[iv + 1, iu]), float(cur[iv + 1, iu + 1])
            value = (1 - fv) * ((1 - fu) * i00 + fu * i01) + fv * ((1 - fu) * i10 + fu * i11)
            gu = ((1 - fv) * (i01 - i00) + fv * (i11 - i10)) / scale
            gv = ((1 - fu) * (i10 - i00) + fu * (i11 - i01)) / scale
            difference = value - prev[v * stride, u * stride]
            e = difference - offset
            total += difference
            count += 1
            d0 = gu * p[2] + gv * p[5]
            d1 = gu * p[3] + gv * p[6]
            d2 = gu * p[4] + gv * p[7]
            jac[0] = y * d2 - z * d1
            jac[1] = z * d0 - x * d2
            jac[2] = x * d1 - y * d0
            weight = 1.0 / max(1.0, abs(e) / 10.0)
            for i in range(3):
                rhs[i] += weight * jac[i] * e
                for j in range(3):
                    normal[i, j] += weight * jac[i] * jac[j]
    return normal, rhs, total / max(count, 1), count


class CoarseRotation:
    """Rotation of the camera between two pyramids."""

    def __init__(self, camera: Camera, levels: int) -> None:
        self._camera = camera
        spacing = 2 ** (levels - 1)  # of the pixels of the previous image that are used, on both levels
        u, v = np.arange(0, camera.width, spacing), np.arange(0, camera.height, spacing)
        self._bearings = camera.unproject(np.stack(np.meshgrid(u, v), -1).astype(np.float64))
        self._strides = {levels - 1: 1, levels - 2: 2}
        self._top = levels - 1
        self._stride = max(round(math.sqrt(u.size * v.size / COMPARED)), 1)
        self._step_rad = SPACING_PX * spacing / camera.fx
        self._tried: tuple[F64, Bool, I32] | None = None  # made when it is needed for the first time

    def search(self, prev: Pyramid, cur: Pyramid) -> F64:
        """The rotation (3, 3) that takes bearings of `prev` into `cur`, whatever the prediction: the best of a grid.

        That is where the brightness of both images correlates most, of rotations at which enough of it is in both.
        """
        rotations, compared, places = self._tried = self._tried or self._places()
        seen, a = places >= 0, prev[self._top][:: self._stride, :: self._stride][compared].astype(np.float64)
        a, b = np.where(seen, a, 0.0), np.where(seen, cur[self._top].ravel()[places], 0.0)
        n, sum_a, sum_b = seen.sum(1), a.sum(1), b.sum(1)
        with np.errstate(all="ignore"):
            spread = ((a * a).sum(1) - sum_a * sum_a / n) * ((b * b).sum(1) - sum_b * sum_b / n)
            alike = ((a * b).sum(1) - sum_a * sum_b / n) / np.sqrt(spread)
        alike[~(n > SEARCHED * seen.shape[1]) | ~(spread > 0)] = -1.0
        return self.align(prev, cur, rotations[int(np.argmax(alike))])

    def _places(self) -> tuple[F64, Bool, I32]:
        """Rotations (M, 3, 3), which of every `_stride`-th pixel are compared, and (M, K) where these would be.

        Places are pixels of the top level, counted row by row; -1 outside of the image.
        """
        rotations, bearings = self._grid(), self._bearings[:: self._stride, :: self._stride]
        compared, (height, width) = np.isfinite(bearings[..., 0]), self._bearings.shape[:2]
        places = np.full((len(rotations), int(compared.sum())), -1, np.int32)
        for rotation, row in zip(rotations, places, strict=True):
            u, v = np.rint(self._camera.project(bearings[compared] @ rotation.T) / 2**self._top).T
            inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
            row[inside] = v[inside] * width + u[inside]
        return rotations, compared, places

    def _grid(self) -> F64:
        """(M, 3, 3) rotations about the image's axes, by which the camera may have turned."""
        b = self._bearings
        angles = [np.arctan2(b[..., k], b[..., 2]) for k in (1, 0)]  # about x, about y
        most = [math.floor(SEARCHED * float(np.nanmax(a) - np.nanmin(a)) / self._step_rad) for a in angles]
        x, y = np.meshgrid(*(self._step_rad * np.arange(-n, n + 1) for n in most), indexing="ij")
        return se3.so3_exp(np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3))

    def align(self, prev: Pyramid, cur: Pyramid, cur_R_prev: F64) -> F64:
        """Improve the rotation (3, 3) that takes bearings of `prev` into `cur`."""
        rotation = np.ascontiguousarray(cur_R_prev)
        for level, stride in self._strides.items():
            offset = 0.0
            for _ in range(ITERATIONS):
                normal, rhs, offset, count = _normal_equations(
                    prev[level], cur[level], self._bearings, stride, self._camera.model_id, self._camera.params,
                    float(2**level), rotation, offset,
                )  # fmt: skip
                if count < 100 or np.linalg.matrix_rank(normal) < 3:
                    return np.ascontiguousarray(cur_R_prev)
                step = -np.linalg.solve(normal, rhs)
                rotation = np.ascontiguousarray(se3.so3_exp(step) @ rotation)
                if np.linalg.norm(step) < COARSE * 2**level / self._camera.fx:
                    break
        return rotation
