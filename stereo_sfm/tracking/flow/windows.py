"""Windows of an image between its pixels, SIZE samples a row at once.

Windows are stored flat with STRIDE samples a row. Left to itself, the compiler converts the 17 pixels of a row one by
one, which takes longer than everything else that is done with a window.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportCallIssue=false

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from stereo_sfm.geometry.kernels import inner, njit

SIZE = 16
STRIDE = SIZE + 4
FLAT_SIZE = SIZE * STRIDE
WIDE_SIZE = (SIZE + 2) * STRIDE
INDEX = ir.IntType(64)
BYTES, FLOATS, FIRST = (ir.VectorType(kind, SIZE) for kind in (ir.IntType(8), ir.FloatType(), ir.IntType(32)))


@intrinsic
def _interpolate(_, image, upper, lower, weights, out, to):
    """Write SIZE samples of an image (H, W) uint8, contiguous, to out[to:], float32.

    Args:
        upper, lower: flat indices of the first sample's pixel in the row above and in the row below.
        weights: four float32, of a sample's upper left, upper right, lower left and lower right pixel.
    """

    def generate(context, builder, signature, arguments):
        source, upper_index, lower_index, four, target, first = arguments
        source = context.make_array(signature.args[0])(context, builder, source).data
        target = context.make_array(signature.args[4])(context, builder, target).data
        total = None
        for k, row in enumerate((upper_index, upper_index, lower_index, lower_index)):
            pixels = builder.gep(source, [builder.add(row, INDEX(k % 2))])
            pixels = builder.load(builder.bitcast(pixels, BYTES.as_pointer()), align=1)
            weight = builder.insert_element(FLOATS(ir.Undefined), builder.extract_value(four, k), INDEX(0))
            weight = builder.shuffle_vector(weight, FLOATS(ir.Undefined), FIRST([0] * SIZE))
            product = builder.fmul(weight, builder.uitofp(pixels, FLOATS))
            total = product if total is None else builder.fadd(total, product)
        builder.store(total, builder.bitcast(builder.gep(target, [first]), FLOATS.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(image, types.intp, types.intp, weights, out, types.intp), generate


@inner
def _weights(fu, fv):
    """Of the four pixels around a place, fu and fv right of and below the upper left one."""
    w00, w01 = np.float32((1 - fu) * (1 - fv)), np.float32(fu * (1 - fv))
    return w00, w01, np.float32((1 - fu) * fv), np.float32(fu * fv)


@njit
def sample(image, u, v, out):
    """Window (FLAT_SIZE,) whose first sample is at (u, v), 0 in the extra columns; the caller has checked that it lies
    inside.
    """
    iu, iv, width = int(math.floor(u)), int(math.floor(v)), image.shape[1]
    weights, at = _weights(u - iu, v - iv), iv * width + iu
    for to in range(0, FLAT_SIZE, STRIDE):
        _interpolate(image, at, at + width, weights, out, to)
        out[to + SIZE] = out[to + SIZE + 1] = out[to + SIZE + 2] = out[to + SIZE + 3] = 0
        at += width


@inner
def sample_wide(image, u, v, out):
    """As `sample`, with one sample more on each side: (WIDE_SIZE,), the first at (u - 1, v - 1), SIZE + 2 rows."""
    u, v = u - 1, v - 1
    iu, iv, width = int(math.floor(u)), int(math.floor(v)), image.shape[1]
    weights, at = _weights(u - iu, v - iv), iv * width + iu
    for to in range(0, WIDE_SIZE, STRIDE):
        _interpolate(image, at, at + width, weights, out, to)
        _interpolate(image, at + 2, at + 2 + width, weights, out, to + 2)  # the last two; those between are the same
        at += width
