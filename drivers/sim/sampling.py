"""Compiled texture lookups: trilinear in each axis of a ripmap, so that nothing aliases at any slant."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportPrivateUsage=false
# pyright: reportConstantRedefinition=false, reportMissingTypeArgument=false

from __future__ import annotations

import math

from stereo_sfm.drivers.sim.kernels import njit_finite


@njit_finite
def _bilinear(data, base, lw, lh, i, j, s, t, wrap):
    """Ripmap level (i, j) at (s, t) in [0, 1]; texel centres at (k + 0.5) / n."""
    w, h = 1 << (lw - i), 1 << (lh - j)
    stride = 2 << lw
    x, y = s * w - 0.5, t * h - 0.5
    x0, y0 = math.floor(x), math.floor(y)
    fx, fy = x - x0, y - y0
    xa, ya = int(x0), int(y0)
    xb, yb = xa + 1, ya + 1
    if wrap:
        xa, xb, ya, yb = xa & (w - 1), xb & (w - 1), ya & (h - 1), yb & (h - 1)
    else:
        xa, xb = min(max(xa, 0), w - 1), min(max(xb, 0), w - 1)
        ya, yb = min(max(ya, 0), h - 1), min(max(yb, 0), h - 1)
    origin = base + ((2 << lh) - ((2 << lh) >> j)) * stride + (2 << lw) - ((2 << lw) >> i)
    ra, rb = origin + ya * stride, origin + yb * stride
    top = data[ra + xa] * (1 - fx) + data[ra + xb] * fx
    low = data[rb + xa] * (1 - fx) + data[rb + xb] * fx
    return top * (1 - fy) + low * fy


@njit_finite
def sample(w, k, s, t, fs, ft):
    """Texture k at (s, t), filtered over a footprint (fs, ft) in the same units; 0..255."""
    data, table = w.texels, w.textures
    base, lw, lh, wrap = table[k, 0], table[k, 1], table[k, 2], table[k, 3]
    if wrap:
        s -= math.floor(s)
        t -= math.floor(t)
    i, j = 0, 0
    fs *= 1 << lw
    ft *= 1 << lh
    while fs >= 2 and i < lw:
        fs *= 0.5
        i += 1
    while ft >= 2 and j < lh:
        ft *= 0.5
        j += 1
    a = min(max(fs - 1, 0.0), 1.0) if i < lw else 0.0
    b = min(max(ft - 1, 0.0), 1.0) if j < lh else 0.0
    value = _bilinear(data, base, lw, lh, i, j, s, t, wrap)
    if a > 0:
        value += a * (_bilinear(data, base, lw, lh, i + 1, j, s, t, wrap) - value)
    if b > 0:
        other = _bilinear(data, base, lw, lh, i, j + 1, s, t, wrap)
        if a > 0:
            other += a * (_bilinear(data, base, lw, lh, i + 1, j + 1, s, t, wrap) - other)
        value += b * (other - value)
    return value


@njit_finite
def over_plane(w, k, a, b, da, db, cos, size):
    """Texture k over a plane: coordinates a, b in metres, ray slopes da, db along them, size = footprint across."""
    wide, high = w.texture_sizes[k, 0], w.texture_sizes[k, 1]
    ic2 = 1 / max(cos * cos, 1e-4)
    fa, fb = size * math.sqrt(1 + da * da * ic2), size * math.sqrt(1 + db * db * ic2)
    return sample(w, k, a / wide, b / high, fa / wide, fb / high)
