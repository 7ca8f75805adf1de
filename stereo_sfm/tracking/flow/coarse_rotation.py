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
from stereo_sfm.types import F64

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


@njit
def _similarities(prev, cur, bearings, stride, model, params, scale, rotations):
    """(M,) correlation of two images' brightness where both are seen, at rotations (M, 3, 3); -1 if that is too little.

    `bearings`: (h, w, 3) of the pixels of a level of the previous image; every `stride`-th is used.
    """
    h, w = bearings.shape[:2]
    hc, wc = cur.shape
    out = np.full(len(rotations), -1.0)
    for m in range(len(rotations)):
        r = rotations[m]
        total, n, sa, sb, saa, sbb, sab = 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0
        for v in range(0, h, stride):
            for u in range(0, w, stride):
                b = bearings[v, u]
                if math.isnan(b[0]):
                    continue
                total += 1
                p = _turned(r, b, model, params)[3]
                if math.isnan(p[0]):
                    continue
                cu, cv = int(round(p[0] / scale)), int(round(p[1] / scale))
                if cu < 0 or cv < 0 or cu >= wc or cv >= hc:
                    continue
                before, now = float(prev[v, u]), float(cur[cv, cu])
                n += 1
                sa += before
                sb += now
                saa += before * before
                sbb += now * now
                sab += before * now
        if n > SEARCHED * total:
            spread = (saa - sa * sa / n) * (sbb - sb * sb / n)
            out[m] = (sab - sa * sb / n) / math.sqrt(spread) if spread > 0 else -1.0
    return out


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

    def search(self, prev: Pyramid, cur: Pyramid) -> F64:
        """The rotation (3, 3) that takes bearings of `prev` into `cur`, whatever the prediction: the best of a grid."""
        rotations = self._grid()
        found = _similarities(
            prev[self._top], cur[self._top], self._bearings, self._stride, self._camera.model_id, self._camera.params,
            float(2**self._top), rotations,
        )  # fmt: skip
        return self.align(prev, cur, rotations[int(np.argmax(found))])

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
