"""Windows of an image between its pixels, and sums over windows, SIZE samples at once.

Windows are SIZE x SIZE pixels around a point, stored flat with STRIDE samples a row; the extra columns make differences
between neighbours contiguous loops and have weight zero. Left to itself, the compiler converts the 17 pixels of a row
one by one and keeps partial sums in memory, which takes longer than everything else that is done with a window. Sums
add halves to halves in a fixed order: the same bits on every run and every machine.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportCallIssue=false

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from stereo_sfm.geometry.kernels import inner, njit

SIZE = 16  # pixels along each side: one vector register of bytes
STRIDE = SIZE + 4  # with the extra columns, a multiple of four
FLAT_SIZE = SIZE * STRIDE
WIDE_SIZE = (SIZE + 2) * STRIDE  # with a pixel more all around, for gradients
# Types of the generated code.
Index = ir.IntType(64)
Bytes, Floats = ir.VectorType(ir.IntType(8), SIZE), ir.VectorType(ir.FloatType(), SIZE)


def lanes(numbers):
    """Of a vector, for `shuffle_vector`."""
    return ir.VectorType(ir.IntType(32), len(numbers))(numbers)


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
            pixels = builder.gep(source, [builder.add(row, Index(k % 2))])
            pixels = builder.load(builder.bitcast(pixels, Bytes.as_pointer()), align=1)
            weight = builder.insert_element(Floats(ir.Undefined), builder.extract_value(four, k), Index(0))
            weight = builder.shuffle_vector(weight, Floats(ir.Undefined), lanes([0] * SIZE))
            product = builder.fmul(weight, builder.uitofp(pixels, Floats))
            total = product if total is None else builder.fadd(total, product)
        builder.store(total, builder.bitcast(builder.gep(target, [first]), Floats.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(image, types.intp, types.intp, weights, out, types.intp), generate


@intrinsic
def dot(_, a, b):
    """Sum of a * b over two flat windows, float32."""

    def generate(context, builder, signature, arguments):
        first, second = (
            context.make_array(kind)(context, builder, array).data
            for kind, array in zip(signature.args, arguments, strict=True)
        )

        def part(at):
            places = (builder.gep(data, [Index(at)]) for data in (first, second))
            return builder.fmul(*(builder.load(builder.bitcast(p, Floats.as_pointer()), align=4) for p in places))

        def tree(parts):
            while len(parts) > 1:
                parts = [builder.fadd(*pair) for pair in zip(parts[::2], parts[1::2], strict=True)]
            return parts[0]

        def column(at):  # of samples 32 apart
            last = builder.fadd(part(at + 256), part(at + 288))
            return builder.fadd(tree([part(at + 64 * k + odd) for odd in (0, 32) for k in range(4)]), last)

        total, size = builder.fadd(column(0), column(SIZE)), SIZE
        while size > 1:
            size //= 2
            halves = (lanes(list(range(k, k + size))) for k in (0, size))
            total = builder.fadd(*(builder.shuffle_vector(total, total, half) for half in halves))
        return builder.extract_element(total, Index(0))

    return types.float32(a, b), generate


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
