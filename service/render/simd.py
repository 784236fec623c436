"""16-wide SIMD types for numba kernels: one source for AVX-512, AVX2 and NEON.

`f32x16`, `i32x16` and `mask16` are numba types that become LLVM vectors, so that a kernel's speed doesn't depend on
whether LLVM vectorizes a loop by itself. A <16 x float> is one register with AVX-512, two with AVX2, four with NEON:

    lane      0     1     2    ...    15
    f32x16 [ x0  | x1  | x2  | ... | x15 ]     16 Gaussians of a chunk, or the 4x4 pixels of a block (row by row)

Operators (+ - * / and comparisons, & | ~ for masks) work lane by lane; a Python number beside a vector is
broadcast. Everything here is for use inside kernels only: a function returns numba's signature and a generator of LLVM
IR. Memory functions take one-dimensional contiguous arrays and an offset in elements, and check no bounds.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic as numba_intrinsic
from numba.extending import models, register_model

LANES = 16
_F32, _I32, _I1, _I64 = ir.FloatType(), ir.IntType(32), ir.IntType(1), ir.IntType(64)
_VF, _VI, _VM = (ir.VectorType(t, LANES) for t in (_F32, _I32, _I1))


class Vector(types.Type):
    def __init__(self, name: str) -> None:
        super().__init__(name=name)


class VectorF(Vector):
    pass


class VectorI(Vector):
    pass


class VectorM(Vector):
    pass


f32x16, i32x16, mask16 = VectorF("f32x16"), VectorI("i32x16"), VectorM("mask16")
_LLVM = {f32x16: _VF, i32x16: _VI, mask16: _VM}


def intrinsic(emit: Callable[..., Any]) -> Callable[..., Any]:
    """Apply numba's decorator, typed as its result: a function without `typingctx`, callable in kernels."""
    return numba_intrinsic(emit)


def _model(numba_type: type, llvm_type: ir.Type) -> None:
    # A value of the type is the LLVM vector itself: it lives in registers.
    @register_model(numba_type)
    class _Model(models.PrimitiveModel):
        def __init__(self, dmm: Any, fe_type: Any) -> None:
            super().__init__(dmm, fe_type, llvm_type)


_model(VectorF, _VF)
_model(VectorI, _VI)
_model(VectorM, _VM)


def _splat(builder: Any, scalar: Any, llvm_type: ir.VectorType) -> Any:
    # LLVM recognizes this pair as a broadcast instruction.
    undef = ir.Constant(llvm_type, ir.Undefined)
    one = builder.insert_element(undef, scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(one, undef, ir.Constant(ir.VectorType(_I32, LANES), [0] * LANES))


def _widened(context: Any, builder: Any, value: Any, source: Any, target: Vector) -> Any:
    """Return a vector as it is; a number is cast to the vector's element type and broadcast."""
    if isinstance(source, Vector):
        return value
    element = types.float32 if target is f32x16 else types.int32
    return _splat(builder, context.cast(builder, value, source, element), _LLVM[target])


# ---- operators -------------------------------------------------------------------------------------------------


def _vector_of(args: tuple) -> Vector | None:
    vectors = {a for a in args if isinstance(a, Vector)}
    if len(vectors) != 1 or not all(isinstance(a, (Vector, types.Number)) for a in args):
        return None
    return vectors.pop()


def _operator(op: Any, kinds: dict[Vector, tuple[Vector, Any]], operands: int = 2) -> None:
    """Register a Python operator: kinds maps the operands' type to the result's type and an IR emitter."""

    @infer_global(op)  # pyright: ignore[reportOptionalCall]
    class _Template(AbstractTemplate):
        def generic(self, args: tuple, kws: dict) -> Any:
            vector = _vector_of(args)
            if vector not in kinds or len(args) != operands:
                return None
            return signature(kinds[vector][0], *args)

    def lower(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        vector = _vector_of(sig.args)
        assert vector is not None
        values = [_widened(context, builder, v, t, vector) for v, t in zip(args, sig.args, strict=True)]
        return kinds[vector][1](builder, *values)

    for vector in kinds:
        if operands == 1:
            lower_builtin(op, type(vector))(lower)
            continue
        # A vector with a vector, and with a number on either side.
        for pair in (
            (type(vector), type(vector)),
            (type(vector), types.Number),
            (types.Number, type(vector)),
        ):
            lower_builtin(op, *pair)(lower)


def _compare(predicate: str) -> dict[Vector, tuple[Vector, Any]]:
    return {
        f32x16: (mask16, lambda b, x, y: b.fcmp_ordered(predicate, x, y)),
        i32x16: (mask16, lambda b, x, y: b.icmp_signed(predicate, x, y)),
    }


_operator(
    operator.add,
    {f32x16: (f32x16, lambda b, x, y: b.fadd(x, y)), i32x16: (i32x16, lambda b, x, y: b.add(x, y))},
)
_operator(
    operator.sub,
    {f32x16: (f32x16, lambda b, x, y: b.fsub(x, y)), i32x16: (i32x16, lambda b, x, y: b.sub(x, y))},
)
_operator(
    operator.mul,
    {f32x16: (f32x16, lambda b, x, y: b.fmul(x, y)), i32x16: (i32x16, lambda b, x, y: b.mul(x, y))},
)
_operator(operator.truediv, {f32x16: (f32x16, lambda b, x, y: b.fdiv(x, y))})
_operator(operator.neg, {f32x16: (f32x16, lambda b, x: b.fneg(x))}, operands=1)
_operator(operator.lshift, {i32x16: (i32x16, lambda b, x, y: b.shl(x, y))})
_operator(operator.rshift, {i32x16: (i32x16, lambda b, x, y: b.lshr(x, y))})
_operator(
    operator.and_,
    {mask16: (mask16, lambda b, x, y: b.and_(x, y)), i32x16: (i32x16, lambda b, x, y: b.and_(x, y))},
)
_operator(
    operator.or_,
    {mask16: (mask16, lambda b, x, y: b.or_(x, y)), i32x16: (i32x16, lambda b, x, y: b.or_(x, y))},
)
_operator(operator.invert, {mask16: (mask16, lambda b, x: b.not_(x))}, operands=1)
for _op, _predicate in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">=")):
    _operator(_op, _compare(_predicate))


# ---- functions -------------------------------------------------------------------------------------------------


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, offset: Any) -> Any:
    """Pointer to element `offset` of a one-dimensional contiguous array."""
    data = cgutils.create_struct_proxy(array_type)(context, builder, array).data
    return builder.gep(data, [offset])


def _function(llvm_name: str, arity: int) -> Any:
    """An intrinsic that maps `arity` float vectors to one through an LLVM function."""

    def typed(*args: Any) -> Any:
        sig = f32x16(*([f32x16] * arity))

        def codegen(context: Any, builder: Any, sig: Any, values: tuple) -> Any:
            fn = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(_VF, [_VF] * arity), f"{llvm_name}.v16f32"
            )
            return builder.call(fn, values)

        return sig, codegen

    return typed


@intrinsic
def fma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c, rounded once."""
    if not all(isinstance(x, (VectorF, types.Number)) for x in (a, b, c)):
        return None  # numba then reports a type error at the call

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        values = [_widened(context, builder, v, t, f32x16) for v, t in zip(args, sig.args, strict=True)]
        fn = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_VF, [_VF] * 3), "llvm.fma.v16f32")
        return builder.call(fn, values)

    return f32x16(a, b, c), codegen


@intrinsic
def sqrt(typingctx: Any, a: Any) -> Any:
    """Square root."""
    return _function("llvm.sqrt", 1)(a)


@intrinsic
def floor(typingctx: Any, a: Any) -> Any:
    """Largest integer not above, as a float."""
    return _function("llvm.floor", 1)(a)


@intrinsic
def splat(typingctx: Any, x: Any) -> Any:
    """One number in every lane, as floats."""

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        return _widened(context, builder, args[0], sig.args[0], f32x16)

    return f32x16(x), codegen


@intrinsic
def isplat(typingctx: Any, x: Any) -> Any:
    """One number in every lane, as integers."""

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        return _widened(context, builder, args[0], sig.args[0], i32x16)

    return i32x16(x), codegen


@intrinsic
def iota(typingctx: Any) -> Any:
    """0, 1, ... 15 as integers."""
    return i32x16(), lambda context, builder, sig, args: ir.Constant(_VI, list(range(LANES)))


def _extreme(predicate: str) -> Any:
    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        x, y = (_widened(context, builder, v, t, f32x16) for v, t in zip(args, sig.args, strict=True))
        # compare and select, not llvm.minnum: that one pays for NaNs
        return builder.select(builder.fcmp_ordered(predicate, x, y), x, y)

    return codegen


@intrinsic
def vmin(typingctx: Any, a: Any, b: Any) -> Any:
    """The smaller one, lane by lane; `b` where one is NaN."""
    return f32x16(a, b), _extreme("<")


@intrinsic
def vmax(typingctx: Any, a: Any, b: Any) -> Any:
    """The larger one, lane by lane; `b` where one is NaN."""
    return f32x16(a, b), _extreme(">")


@intrinsic
def select(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """`a` where the mask is set, else `b`; numbers are broadcast."""
    vector = i32x16 if i32x16 in (a, b) else f32x16  # two numbers become floats

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        x, y = (_widened(context, builder, v, t, vector) for v, t in zip(args[1:], sig.args[1:], strict=True))
        return builder.select(args[0], x, y)

    return vector(mask, a, b), codegen


@intrinsic
def bits(typingctx: Any, mask: Any) -> Any:
    """The mask as an integer, lane 0 in the lowest bit."""

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(16)), _I32)

    return types.uint32(mask), codegen


@intrinsic
def popcount(typingctx: Any, x: Any) -> Any:
    """Number of set bits."""

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        return builder.zext(builder.ctpop(args[0]), _I64)

    return types.intp(types.uint32), codegen


@intrinsic
def to_int(typingctx: Any, a: Any) -> Any:
    """Truncate towards zero."""
    return i32x16(a), lambda context, builder, sig, args: builder.fptosi(args[0], _VI)


@intrinsic
def to_float(typingctx: Any, a: Any) -> Any:
    """Integers as floats of the same value."""
    return f32x16(a), lambda context, builder, sig, args: builder.sitofp(args[0], _VF)


@intrinsic
def as_int(typingctx: Any, a: Any) -> Any:
    """The same bits, as integers."""
    return i32x16(a), lambda context, builder, sig, args: builder.bitcast(args[0], _VI)


@intrinsic
def as_float(typingctx: Any, a: Any) -> Any:
    """The same bits, as floats."""
    return f32x16(a), lambda context, builder, sig, args: builder.bitcast(args[0], _VF)


@intrinsic
def sum16(typingctx: Any, a: Any) -> Any:
    """Sum over the lanes, pairwise."""

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        # Four rotations and additions; afterwards every lane has the sum.
        vector, undef = args[0], ir.Constant(_VF, ir.Undefined)
        for half in (8, 4, 2, 1):
            order = [(i + half) % LANES for i in range(LANES)]
            vector = builder.fadd(vector, builder.shuffle_vector(vector, undef, ir.Constant(_VI, order)))
        return builder.extract_element(vector, ir.Constant(_I32, 0))

    return types.float32(a), codegen


@intrinsic
def load(typingctx: Any, array: Any, offset: Any) -> Any:
    """16 consecutive float32 of a one-dimensional contiguous array."""

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        # Aligned to 4 bytes only: most arrays start at a cache line, but offsets are of any number of floats.
        p = _pointer(context, builder, sig.args[0], args[0], args[1])
        return builder.load(builder.bitcast(p, _VF.as_pointer()), align=4, typ=_VF)

    return f32x16(array, types.intp), codegen


@intrinsic
def iload(typingctx: Any, array: Any, offset: Any) -> Any:
    """16 consecutive int32."""

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        p = _pointer(context, builder, sig.args[0], args[0], args[1])
        return builder.load(builder.bitcast(p, _VI.as_pointer()), align=4, typ=_VI)

    return i32x16(array, types.intp), codegen


@intrinsic
def broadcast(typingctx: Any, array: Any, offset: Any) -> Any:
    """One float32 in every lane; unlike array[offset] without the test for a negative index."""

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        p = _pointer(context, builder, sig.args[0], args[0], args[1])
        return _splat(builder, builder.load(p), _VF)

    return f32x16(array, types.intp), codegen


@intrinsic
def at(typingctx: Any, array: Any, offset: Any) -> Any:
    """array[offset] of a one-dimensional contiguous int32 array as an index, without the test for a negative one."""

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        p = _pointer(context, builder, sig.args[0], args[0], args[1])
        return builder.zext(builder.load(p), _I64)

    return types.intp(array, types.intp), codegen


@intrinsic
def store(typingctx: Any, array: Any, offset: Any, vector: Any) -> Any:
    """Write 16 consecutive elements (float32 or int32)."""

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        p = _pointer(context, builder, sig.args[0], args[0], args[1])
        builder.store(args[2], builder.bitcast(p, _LLVM[sig.args[2]].as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), codegen


@intrinsic
def store_quarter(typingctx: Any, array: Any, offset: Any, vector: Any, quarter: Any) -> Any:
    """Write 4 consecutive float32: lanes 4 q .. 4 q + 3 of the vector; `quarter` is a literal."""
    if not isinstance(quarter, types.IntegerLiteral):
        from numba.core.errors import RequireLiteralValue

        raise RequireLiteralValue("quarter")
    first = 4 * quarter.literal_value

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        p = _pointer(context, builder, sig.args[0], args[0], args[1])
        lanes = ir.Constant(ir.VectorType(_I32, 4), [first + i for i in range(4)])
        part = builder.shuffle_vector(args[2], ir.Constant(_VF, ir.Undefined), lanes)
        builder.store(part, builder.bitcast(p, ir.VectorType(_F32, 4).as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector, quarter), codegen


@intrinsic
def gather(typingctx: Any, array: Any, index: Any) -> Any:
    """float32 elements of a one-dimensional contiguous array at 16 indices."""

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        data = cgutils.create_struct_proxy(sig.args[0])(context, builder, args[0]).data
        pointers = ir.VectorType(_F32.as_pointer(), LANES)
        # Addresses as 64-bit integers, 4 bytes an element.
        wide = builder.sext(args[1], ir.VectorType(_I64, LANES))
        base = _splat(builder, builder.ptrtoint(data, _I64), ir.VectorType(_I64, LANES))
        four = ir.Constant(ir.VectorType(_I64, LANES), [4] * LANES)
        address = builder.inttoptr(builder.add(base, builder.mul(wide, four)), pointers)
        fn = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(_VF, [pointers, _I32, _VM, _VF]),
            "llvm.masked.gather.v16f32.v16p0",
        )
        every = ir.Constant(_VM, [1] * LANES)
        return builder.call(fn, [address, ir.Constant(_I32, 4), every, ir.Constant(_VF, ir.Undefined)])

    return f32x16(array, index), codegen


@intrinsic
def compress(typingctx: Any, vector: Any, mask: Any) -> Any:
    """Move the lanes whose mask is set to the front, in order; the rest is undefined."""

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        # One instruction with AVX-512; LLVM emulates it elsewhere.
        kind = _LLVM[sig.args[0]]
        suffix = "v16f32" if sig.args[0] is f32x16 else "v16i32"
        fn = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(kind, [kind, _VM, kind]),
            f"llvm.experimental.vector.compress.{suffix}",
        )
        return builder.call(fn, [args[0], args[1], ir.Constant(kind, ir.Undefined)])

    return vector(vector, mask), codegen


@intrinsic
def transpose16(
    typingctx: Any,
    source: Any,
    source_offset: Any,
    source_stride: Any,
    target: Any,
    target_offset: Any,
    stride: Any,
) -> Any:
    """Read 16 vectors `source_stride` apart, transpose the 16x16 matrix, write them `stride` apart.

    Four rounds that exchange halves at distance 8, 4, 2, 1; every round pairs vector i with vector i + distance.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        rows = []
        for i in range(LANES):
            at = builder.add(args[1], builder.mul(args[2], ir.Constant(_I64, i)))
            p = _pointer(context, builder, sig.args[0], args[0], at)
            rows.append(builder.load(builder.bitcast(p, _VF.as_pointer()), align=4, typ=_VF))
        for distance in (8, 4, 2, 1):
            low = [i if not i & distance else i - distance + LANES for i in range(LANES)]
            high = [i + distance if not i & distance else i + LANES for i in range(LANES)]
            done: list = [None] * LANES
            for i in range(LANES):
                if not i & distance:
                    x, y = rows[i], rows[i + distance]
                    done[i] = builder.shuffle_vector(x, y, ir.Constant(_VI, low))
                    done[i + distance] = builder.shuffle_vector(x, y, ir.Constant(_VI, high))
            rows = done
        for i in range(LANES):
            at = builder.add(args[4], builder.mul(args[5], ir.Constant(_I64, i)))
            p = _pointer(context, builder, sig.args[3], args[3], at)
            builder.store(rows[i], builder.bitcast(p, _VF.as_pointer()), align=4)
        return context.get_dummy_value()

    i = types.intp
    return types.void(source, i, i, target, i, i), codegen


@intrinsic
def store_rgb_rows(typingctx: Any, array: Any, offset: Any, row_stride: Any, r: Any, g: Any, b: Any) -> Any:
    """Write a 4x4 block of three planes into an interleaved image: 4 rows of 12 floats, `row_stride` apart."""

    def codegen(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        red, green, blue = args[3:]
        # Interleave row by row: two-source shuffles first (r, g), then blue is put between.
        for row in range(4):
            first = 4 * row
            rg = ir.Constant(_VI, [first + i // 3 + (LANES if i % 3 == 1 else 0) for i in range(12)] + [0] * 4)
            pair = builder.shuffle_vector(red, green, rg)
            mix = [LANES + first + i // 3 if i % 3 == 2 else i for i in range(12)]
            mixed = builder.shuffle_vector(pair, blue, ir.Constant(ir.VectorType(_I32, 12), mix))
            at = builder.add(args[1], builder.mul(args[2], ir.Constant(_I64, row)))
            for start, size in ((0, 8), (8, 4)):
                lanes = ir.Constant(ir.VectorType(_I32, size), [start + i for i in range(size)])
                part = builder.shuffle_vector(mixed, ir.Constant(ir.VectorType(_F32, 12), ir.Undefined), lanes)
                p = _pointer(context, builder, sig.args[0], args[0], builder.add(at, ir.Constant(_I64, start)))
                builder.store(part, builder.bitcast(p, ir.VectorType(_F32, size).as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, r, g, b), codegen
