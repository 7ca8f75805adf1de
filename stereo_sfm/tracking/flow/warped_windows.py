"""Affinely deformed windows of an image, SIZE samples at once."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportCallIssue=false

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from stereo_sfm.geometry.kernels import inner
from stereo_sfm.tracking.flow.windows import SIZE, STRIDE, Floats, Index, lanes

HALF = 7.5  # from the centre of a window to its first sample
MAX_REACH = 60.0  # px from the centre of a warped window
# Types of the generated code.
Word, Words = ir.IntType(32), ir.VectorType(ir.IntType(32), SIZE)


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
def _interpolate(_, image, first, width, start, step, out, to):
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
        _interpolate(image, top * w + left, np.int32(w), (b * y + du, d * y + dv), (a, c), out, i * STRIDE)
    return True
