"""Scalar operations of programs, each with its text in LLVM's language and in C."""

from typing import NamedTuple


class Form(NamedTuple):
    """How an operation is written, with its operands in braces.

    Args:
        llvm: LLVM's instruction; ``number`` and ``truth`` are the types of lanes, ``lanes`` is their number.
        c: C's expression.
    """

    llvm: str
    c: str


ARITHMETIC = {"add": "+", "sub": "-", "mul": "*", "div": "/"}
COMPARISONS = {
    "gt": ("ogt", ">"), "lt": ("olt", "<"), "ge": ("oge", ">="), "le": ("ole", "<="), "eq": ("oeq", "=="),
    "ne": ("une", "!="),
}  # fmt: skip
"""Comparisons in LLVM and in C, of which NaN makes all false but the last one."""
LOGIC = {"and": "&&", "or": "||", "xor": "!="}
ROUNDED = {"sqrt": "sqrt", "floor": "floor", "ceil": "ceil", "trunc": "trunc", "round": "rint", "abs": "fabs"}
"""Functions that are instructions of most processors, by their names in LLVM and C; halves are rounded to even."""
EXTREMES = {"minimum": "{0} < {1} || {0} != {0} ? {0} : {1}", "maximum": "{0} > {1} || {0} != {0} ? {0} : {1}"}
"""Extremes, which are NaN if one of the two is NaN."""
FORMS = {
    **{name: Form(f"f{name} contract {{number}} {{0}}, {{1}}", f"{{0}} {c} {{1}}") for name, c in ARITHMETIC.items()},
    **{name: Form(f"fcmp {how} {{number}} {{0}}, {{1}}", f"{{0}} {c} {{1}}") for name, (how, c) in COMPARISONS.items()},
    **{name: Form(f"{name} {{truth}} {{0}}, {{1}}", f"{{0}} {c} {{1}}") for name, c in LOGIC.items()},
    **{
        name: Form(f"call {{number}} @llvm.{known}.v{{lanes}}f64({{number}} {{0}})", f"{known}({{0}})")
        for name, known in ROUNDED.items()
    },
    **{
        name: Form(f"call nsz {{number}} @llvm.{name}.v{{lanes}}f64({{number}} {{0}}, {{number}} {{1}})", c)
        for name, c in EXTREMES.items()
    },
    "neg": Form("fneg {number} {0}", "-{0}"),
    "not": Form("xor {truth} {0}, splat (i1 true)", "!{0}"),
    "select": Form("select {truth} {0}, {number} {1}, {number} {2}", "{0} ? {1} : {2}"),
}
"""Operations that are instructions. Products and sums may be contracted into one rounding; nothing else of
floating-point arithmetic is relaxed."""
FUNCTIONS = {
    **dict.fromkeys("exp exp2 expm1 log log1p log2 log10 sin cos tan tanh sinh cosh asin acos atan".split(), 1),
    **dict.fromkeys("asinh acosh atanh erf erfc".split(), 1),
    **dict.fromkeys("pow atan2 hypot fmod".split(), 2),
}
"""Functions of the C library, under its names and torch's, and the numbers of their arguments."""
