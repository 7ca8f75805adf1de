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
HALF = 7.5  # from the centre of a window to its first sample
MAX_REACH = 60.0  # px from the centre of a warped window
# Types of the generated code.
Index, Word, Words = ir.IntType(64), ir.IntType(32), ir.VectorType(ir.IntType(32), SIZE)
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


def _splat(builder, value, kind):
    """A vector of one value."""
    none = kind(ir.Undefined)
    return builder.shuffle_vector(builder.insert_element(none, value, Index(0)), none, lanes([0] * SIZE))


def _gathered(builder, data, first, index):
    """The four pixels from each of SIZE pixels on, each in one word."""
    words = Words(ir.Undefined)
    for k in range(SIZE):
        at = builder.add(first, builder.sext(builder.extract_element(index, Index(k)), Index))
        place = builder.bitcast(builder.gep(data, [at]), Word.as_pointer())
        words = builder.insert_element(words, builder.load(place, align=1), Index(k))
    return words


@intrinsic
def _interpolate_along(_, image, first, width, start, step, out, to):
    """Write SIZE samples of an image (H, W) uint8, contiguous, to out[to:], float32.

    Args:
        first: flat index of the pixel from which places are counted. width: W, int32.
        start, step: (u, v) float32, px, of the first sample, and from one to the next.
    """

    def generate(context, builder, signature, arguments):
        source, first, width, start, step, target, to = arguments
        source = context.make_array(signature.args[0])(context, builder, source).data
        target = context.make_array(signature.args[5])(context, builder, target).data
        x = Floats([k - HALF for k in range(SIZE)])
        whole, share = list[ir.Value](), list[ir.Value]()
        for k in range(2):
            begin, slope = (_splat(builder, builder.extract_value(pair, k), Floats) for pair in (start, step))
            place = builder.fadd(builder.fmul(slope, x), begin)
            whole.append(builder.fptosi(place, Words))
            share.append(builder.fsub(place, builder.sitofp(whole[k], Floats)))
        index = builder.add(builder.mul(whole[1], _splat(builder, width, Words)), whole[0])
        upper = _gathered(builder, source, first, index)
        # From two pixels further left: the last pixel of the image is the last of a word.
        lower = _gathered(builder, source, builder.add(first, builder.sext(builder.sub(width, Word(2)), Index)), index)

        def pixels(words, k):
            byte = builder.and_(builder.lshr(words, Words([8 * k] * SIZE)), Words([255] * SIZE))
            return builder.sitofp(byte, Floats)

        def between(a, b, share):
            return builder.fadd(a, builder.fmul(share, builder.fsub(b, a)))

        rows = [between(pixels(words, k), pixels(words, k + 1), share[0]) for words, k in ((upper, 0), (lower, 2))]
        place = builder.bitcast(builder.gep(target, [to]), Floats.as_pointer())
        builder.store(between(*rows, share[1]), place, align=4)
        return context.get_dummy_value()

    return types.void(image, types.intp, types.int32, start, step, out, types.intp), generate


@inner
def sample_affine(image, warp, cu, cv, out):
    """Window at warp @ (x, y) + (cu, cv); False when it leaves the image."""
    h, w = image.shape
    reach_u = (abs(warp[0, 0]) + abs(warp[0, 1])) * HALF
    reach_v = (abs(warp[1, 0]) + abs(warp[1, 1])) * HALF
    inside = cu - reach_u >= 0 and cv - reach_v >= 0 and cu + reach_u < w - 1.001 and cv + reach_v < h - 1.001
    if not (inside and reach_u < MAX_REACH and reach_v < MAX_REACH):  # also when anything is NaN
        return False
    left, top = max(int(cu - reach_u - 0.01), 0), max(int(cv - reach_v - 0.01), 0)
    a, b, c, d = np.float32(warp[0, 0]), np.float32(warp[0, 1]), np.float32(warp[1, 0]), np.float32(warp[1, 1])
    du, dv = np.float32(cu - left), np.float32(cv - top)
    for i in range(SIZE):
        y = np.float32(i - HALF)
        _interpolate_along(image, top * w + left, np.int32(w), (b * y + du, d * y + dv), (a, c), out, i * STRIDE)
    return True
