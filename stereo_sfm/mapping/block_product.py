"""Products of blocks of a keyframe pair, six entries at once.

Left to itself, the compiler cannot know that the arrays do not overlap, and multiplies entry by entry.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

# Types of the compiler: a number of an entry, six entries, six numbers of entries.
Index, Row, First = ir.IntType(64), ir.VectorType(ir.DoubleType(), 6), ir.VectorType(ir.IntType(32), 6)


@intrinsic
def subtract_product(_, a, m, b, n, blocks, slot):
    """Subtract A^T B from blocks[slot] (6, 6), with A and B (3, 6) the rows m and n of a and b (., 18), contiguous."""

    def generate(context, builder, signature, arguments):
        kinds = signature.args
        first, second, third = (context.make_array(kinds[k])(context, builder, arguments[k]).data for k in (0, 2, 4))

        def row(data, index, size, k):
            place = builder.gep(data, [builder.add(builder.mul(index, Index(size)), Index(6 * k))])
            return builder.bitcast(place, Row.as_pointer())

        factors = [builder.load(row(second, arguments[3], 18, c), align=8) for c in range(3)]
        entries = [builder.load(row(first, arguments[1], 18, c), align=8) for c in range(3)]
        rows = [row(third, arguments[5], 36, k) for k in range(6)]
        for k in range(6):
            total = None
            for c in range(3):
                entry = builder.shuffle_vector(entries[c], Row(ir.Undefined), First([k] * 6))
                product = builder.fmul(entry, factors[c])
                total = product if total is None else builder.fadd(total, product)
            builder.store(builder.fsub(builder.load(rows[k], align=8), total), rows[k], align=8)
        return context.get_dummy_value()

    return types.void(a, types.intp, b, types.intp, blocks, types.intp), generate
