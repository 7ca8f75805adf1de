"""Optical flow of points: translation between images, affine against the patch where a point was first seen.

Shi & Tomasi, Good Features to Track (CVPR 1994): translation follows a feature from frame to frame; the affine model
against its first appearance removes the drift, and its dissimilarity detects windows that no longer show one surface
(an occlusion, or a depth discontinuity inside the window). Both are inverse compositional (Baker & Matthews, IJCV 56,
2004). The brightness of a window is normalised by its mean and contrast, so that exposure jumps do not matter.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportPrivateUsage=false, reportCallIssue=false
# pyright: reportConstantRedefinition=false, reportMissingTypeArgument=false

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from stereo_sfm.geometry.kernels import inner, njit
from stereo_sfm.geometry.small_matrix import invert_symmetric
from stereo_sfm.tracking.flow.windows import (
    FLAT_SIZE,
    HALF,
    SIZE,
    STRIDE,
    WIDE_SIZE,
    dot,
    sample,
    sample_affine,
    sample_wide,
)
from stereo_sfm.types import F32, F64, U8

FINE, COARSE = 0.01, 0.1  # px, last step of an alignment: in the image itself, and where a finer one follows
ITERATIONS = 10  # on each level, at most: most need four

Pyramid = tuple[U8, ...]


@dataclass(frozen=True)
class StereoPyramids:
    """Input of the flow tracker from one stereo image."""

    left: Pyramid
    right: Pyramid | F32  # the second camera's pyramid, or the depth image of an RGB-D camera


class Appearances(NamedTuple):
    """First appearances of M points, for `track_affine`."""

    patch: F32  # (M, FLAT_SIZE) grey levels without their mean
    gradients: F32  # (M, 2, FLAT_SIZE) times the weights
    inverse_normal: F64  # (M, 6, 6)
    contrast: F64  # (M,)
    bending: F64  # (M, 6, 6) what the quadratic part of a deformation adds to the right-hand side, by its coefficients

    @staticmethod
    def empty(count: int) -> Appearances:
        """Of so many points."""
        patch, gradients = np.zeros((count, FLAT_SIZE), np.float32), np.zeros((count, 2, FLAT_SIZE), np.float32)
        return Appearances(patch, gradients, np.zeros((count, 6, 6)), np.zeros(count), np.zeros((count, 6, 6)))


def build_pyramid(image: U8, levels: int) -> Pyramid:
    """Image (H, W) and its halvings, finest first; level k holds pixel u at u / 2**k."""
    out = [np.ascontiguousarray(image)]
    for _ in range(levels - 1):
        out.append(cv2.pyrDown(out[-1]).astype(np.uint8, copy=False))
    out[0] = out[0].view()
    for level in out:  # one array type for the compiled kernels
        level.flags.writeable = False
    return tuple(out)


def _window_weights() -> np.ndarray:
    """Flat window of weights: a wide Gaussian, zero in the extra columns, sum 1."""
    x = np.arange(SIZE) - HALF
    g = np.exp(-0.5 * (x / 3.5) ** 2)
    w = np.zeros((SIZE, STRIDE))
    w[:, :SIZE] = np.outer(g, g)
    return (w / w.sum()).astype(np.float32).ravel()


def _window_coordinates() -> np.ndarray:
    """(3, FLAT_SIZE): x, y and 1 of every sample."""
    x = np.zeros((3, SIZE, STRIDE), np.float32)
    x[0, :, :SIZE] = np.arange(SIZE) - HALF
    x[1, :, :SIZE] = (np.arange(SIZE) - HALF)[:, None]
    x[2] = 1
    return x.reshape(3, FLAT_SIZE)


WEIGHTS = _window_weights()
COORDINATES = _window_coordinates()


@njit
def _inside(image, u, v, margin):
    h, w = image.shape
    return u >= margin and v >= margin and u < w - 1 - margin and v < h - 1 - margin


@inner
def _template(image, u, v, weights, raw, wide, patch, gx, gy):
    """Patch around (u, v), centred, and its weighted, centred gradients by central differences.

    Returns contrast, the 2x2 normal matrix (hxx, hxy, hyy), and the mean gradients. `gx`, `gy` are left multiplied
    by the weights: their dot product with a window is the right-hand side, whatever the window's mean.
    """
    half = np.float32(0.5)
    sample_wide(image, u - HALF, v - HALF, wide)
    for m in range(FLAT_SIZE):
        patch[m] = wide[m + STRIDE + 1]
        gx[m] = half * (wide[m + STRIDE + 2] - wide[m + STRIDE])
        gy[m] = half * (wide[m + 2 * STRIDE + 1] - wide[m + 1])
    mean = dot(patch, weights)
    mx = dot(gx, weights)
    my = dot(gy, weights)
    for m in range(FLAT_SIZE):
        patch[m] -= mean
        raw[m] = (gx[m] - mx) * weights[m]
    hxx = dot(raw, gx)
    hxy = dot(raw, gy)
    for m in range(FLAT_SIZE):
        gx[m] = raw[m]
        raw[m] = (gy[m] - my) * weights[m]
    hyy = dot(raw, gy)
    for m in range(FLAT_SIZE):
        gy[m] = raw[m]
        raw[m] = patch[m] * weights[m]
    contrast = math.sqrt(max(dot(raw, patch), 1e-6))
    return contrast, hxx, hxy, hyy, mx, my


@njit
def _compare(window, patch, weights, raw):
    """Mean and contrast of a window, and its normalised correlation times contrast with a centred patch."""
    mean = dot(window, weights)
    for m in range(FLAT_SIZE):
        raw[m] = (window[m] - mean) * weights[m]
    cross = dot(raw, patch)
    variance = dot(raw, window)
    return mean, math.sqrt(max(variance, 1e-6)), cross


@njit
def track_translation(prev, cur, uv, guess, first_level, last_level, min_contrast, min_ncc, weights):
    """Follow points from one pyramid into another.

    Args:
        prev, cur: pyramids (tuples of uint8 images). uv, guess: (N, 2) px in prev[0], and predicted in cur[0].
        first_level, last_level: coarsest level to start at, finest level to end at (0 is the image itself).
        min_contrast: grey levels of standard deviation below which a window is flat.
        min_ncc: least normalised correlation of the windows at the end. weights: WEIGHTS.

    Returns:
        (N, 2) px in cur[0]; NaN outside of an image, where a window is flat or unlike, or where the search diverges.
    """
    out = np.full(uv.shape, np.nan)
    raw = np.zeros(FLAT_SIZE, np.float32)
    patch = np.zeros(FLAT_SIZE, np.float32)
    gx = np.zeros(FLAT_SIZE, np.float32)
    gy = np.zeros(FLAT_SIZE, np.float32)
    wide = np.zeros(WIDE_SIZE + STRIDE, np.float32)
    window = np.zeros(FLAT_SIZE, np.float32)
    for k in range(uv.shape[0]):
        u, v = guess[k, 0], guess[k, 1]
        found = False
        for level in range(first_level, last_level - 1, -1):
            found = False
            scale = 1.0 / (1 << level)
            image, target = prev[level], cur[level]
            pu, pv = uv[k, 0] * scale, uv[k, 1] * scale
            cu, cv = u * scale, v * scale
            if not (_inside(image, pu, pv, HALF + 1.5) and _inside(target, cu, cv, HALF + 0.5)):  # also NaN
                continue
            contrast, hxx, hxy, hyy, _, _ = _template(image, pu, pv, weights, raw, wide, patch, gx, gy)
            det = hxx * hyy - hxy * hxy
            if contrast < min_contrast or det < 1e-3 * (hxx + hyy) * (hxx + hyy):
                continue
            found = True
            start_u, start_v = cu, cv
            tx, ty = dot(gx, patch), dot(gy, patch)
            gain = 1.0
            for iteration in range(ITERATIONS):
                if not _inside(target, cu, cv, HALF + 0.5):
                    found = False
                    break
                sample(target, cu - HALF, cv - HALF, window)
                if iteration == 0 or iteration == 2:
                    _, contrast_c, _ = _compare(window, patch, weights, raw)
                    gain = min(max(contrast / contrast_c, 0.4), 2.5)
                bx = gain * dot(gx, window) - tx
                by = gain * dot(gy, window) - ty
                du = (hyy * bx - hxy * by) / det
                dv = (hxx * by - hxy * bx) / det
                length = math.sqrt(du * du + dv * dv)
                if length > 2.0:  # a linearisation is worth two pixels at most
                    du, dv = du * 2.0 / length, dv * 2.0 / length
                cu -= du
                cv -= dv
                if length < (FINE if level == 0 else COARSE):
                    break
            found = found and (cu - start_u) ** 2 + (cv - start_v) ** 2 <= 100.0
            if found and level == last_level:
                found = _inside(target, cu, cv, HALF + 0.5)
                if found:
                    sample(target, cu - HALF, cv - HALF, window)
                    _, contrast_c, cross = _compare(window, patch, weights, raw)
                    found = np.float32(cross / (contrast * contrast_c)) >= min_ncc
            if not found:
                break
            u, v = cu / scale, cv / scale
        if found:
            out[k, 0], out[k, 1] = u, v
    return out


@njit
def make_patches(image, uv, slots, store, weights, coordinates):
    """Store the appearance of points for `track_affine`.

    Args:
        image: (H, W) uint8, in which the points are first observed. uv: (N, 2) px.
        slots: (N,) rows of `store`, `Appearances`, which are filled in. weights, coordinates: WEIGHTS, COORDINATES.

    Returns:
        (N,) bool, False where the window leaves the image or has no texture.
    """
    patch, gradients, inverse_normal, contrast, bending = store
    n = uv.shape[0]
    good = np.zeros(n, np.bool_)
    raw = np.zeros(FLAT_SIZE, np.float32)
    wide = np.zeros(WIDE_SIZE + STRIDE, np.float32)
    jac = np.zeros((6, FLAT_SIZE), np.float32)
    unweighted = np.zeros(FLAT_SIZE, np.float32)
    normal, factor = np.zeros((6, 6)), np.zeros((6, 6))
    for row in range(n):
        if not _inside(image, uv[row, 0], uv[row, 1], HALF + 1.5):
            continue
        k = slots[row]
        gx, gy = gradients[k, 0], gradients[k, 1]
        result = _template(image, uv[row, 0], uv[row, 1], weights, raw, wide, patch[k], gx, gy)
        contrast[k] = result[0]
        if contrast[k] < 1.0:
            continue
        # gx, gy are already weighted; a second factor for the normal matrix needs them unweighted.
        for m in range(FLAT_SIZE):
            jac[0, m] = gx[m] * coordinates[0, m]
            jac[1, m] = gx[m] * coordinates[1, m]
            jac[2, m] = gx[m]
            jac[3, m] = gy[m] * coordinates[0, m]
            jac[4, m] = gy[m] * coordinates[1, m]
            jac[5, m] = gy[m]
        for m in range(FLAT_SIZE):
            raw[m] = np.float32(1.0) / max(weights[m], np.float32(1e-9)) if weights[m] > 0 else np.float32(0)
        for a in range(6):
            for m in range(FLAT_SIZE):
                wide[m] = jac[a, m] * raw[m]
            for b in range(a, 6):
                normal[a, b] = dot(jac[b], wide)
                normal[b, a] = normal[a, b]
        # The affine part is a small departure from what it was: damped by what one grey-level-noise step may do.
        damping = 0.02 * (normal[2, 2] + normal[5, 5])
        for a in (0, 1, 3, 4):
            normal[a, a] += damping * HALF * HALF
        if normal[2, 2] * normal[5, 5] - normal[2, 5] ** 2 < 1e-3 * (normal[2, 2] + normal[5, 5]) ** 2:
            continue
        good[row] = invert_symmetric(normal, inverse_normal[k], factor)
        for a in range(2):
            mean_gradient = np.float32(result[4] if a == 0 else result[5])
            for m in range(FLAT_SIZE):
                unweighted[m] = gradients[k, a, m] * raw[m] + mean_gradient
            for c in range(3):
                x, y = coordinates[1 if c == 2 else 0], coordinates[0 if c == 0 else 1]
                half = np.float32(1.0 if c == 1 else 0.5)
                for m in range(FLAT_SIZE):
                    wide[m] = half * x[m] * y[m] * unweighted[m]
                mean = dot(weights, wide)
                for m in range(FLAT_SIZE):
                    wide[m] -= mean
                for b in range(6):
                    bending[k, b, 3 * a + c] = dot(jac[b], wide)
    return good


@njit
def track_affine(image, uv, warp, curvature, slots, wanted, store, iterations, weights, coordinates):
    """Align the first appearance of points with an image.

    Args:
        image: (H, W) uint8. uv: (N, 2) px and warp: (N, 2, 2), the positions and affine deformations to start from;
            overwritten. curvature: (N, 6) the deformations' quadratic parts, see `window_curvatures`. slots: (N,) rows
            of the points in the `store` that `make_patches` filled. wanted: (N,) bool, others are skipped.

    Returns:
        ncc (N,) float32 normalised correlation after alignment, 0 where the window left the image or did not converge.
    """
    patch, gradients, inverse_normal, contrast, bending = store
    n = uv.shape[0]
    ncc = np.zeros(n, np.float32)
    window = np.zeros(FLAT_SIZE, np.float32)  # zero beyond the samples, always
    error = np.zeros(FLAT_SIZE, np.float32)
    raw = np.zeros(FLAT_SIZE, np.float32)
    bx = np.zeros(FLAT_SIZE, np.float32)
    b = np.zeros(6)
    step = np.zeros(6)
    for row in range(n):
        if not wanted[row]:
            continue
        k = slots[row]
        a00, a01, a10, a11 = warp[row, 0, 0], warp[row, 0, 1], warp[row, 1, 0], warp[row, 1, 1]
        cu, cv = uv[row, 0], uv[row, 1]
        w2 = np.empty((2, 2))
        ok = True
        for _ in range(iterations):
            w2[0, 0], w2[0, 1], w2[1, 0], w2[1, 1] = a00, a01, a10, a11
            if not sample_affine(image, w2, cu, cv, window):
                ok = False
                break
            mean, contrast_c, cross = _compare(window, patch[k], weights, raw)
            gain = np.float32(min(max(contrast[k] / contrast_c, 0.3), 3.0))
            ncc[row] = cross / (contrast[k] * contrast_c)
            for m in range(FLAT_SIZE):
                error[m] = gain * (window[m] - mean) - patch[k, m]
            for axis in range(2):
                for m in range(FLAT_SIZE):
                    bx[m] = gradients[k, axis, m] * error[m]
                b[3 * axis] = dot(bx, coordinates[0])
                b[3 * axis + 1] = dot(bx, coordinates[1])
                b[3 * axis + 2] = dot(bx, coordinates[2])
            for i in range(6):
                for j in range(6):
                    b[i] += bending[k, i, j] * curvature[row, j]
            for i in range(6):
                s = 0.0
                for j in range(6):
                    s += inverse_normal[k, i, j] * b[j]
                step[i] = s
            length = math.sqrt(step[2] ** 2 + step[5] ** 2)
            if length > 2.0 or abs(step[0]) + abs(step[1]) + abs(step[3]) + abs(step[4]) > 1.0:
                ok = False
                break
            # warp <- warp o (I + step)^-1
            d00, d01, d10, d11 = 1 + step[0], step[1], step[3], 1 + step[4]
            det = d00 * d11 - d01 * d10
            i00, i01, i10, i11 = d11 / det, -d01 / det, -d10 / det, d00 / det
            tu, tv = -(i00 * step[2] + i01 * step[5]), -(i10 * step[2] + i11 * step[5])
            cu += a00 * tu + a01 * tv
            cv += a10 * tu + a11 * tv
            a00, a01, a10, a11 = (
                a00 * i00 + a01 * i10,
                a00 * i01 + a01 * i11,
                a10 * i00 + a11 * i10,
                a10 * i01 + a11 * i11,
            )
            if length < 0.03:
                break
        if not ok:
            ncc[row] = 0
            continue
        uv[row, 0], uv[row, 1] = cu, cv
        warp[row, 0, 0], warp[row, 0, 1], warp[row, 1, 0], warp[row, 1, 1] = a00, a01, a10, a11
    return ncc
