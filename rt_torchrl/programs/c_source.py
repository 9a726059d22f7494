"""Programs as C99: scalar functions of one file that share their constants."""

import math
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from rt_torchrl.programs.lowering import Lowering
from rt_torchrl.programs.program import C_NAMES, COMPARISONS, ROUNDED, Program

WIDTH = 110
FORMS = {
    **{name: f"{{0}} {sign} {{1}}" for name, sign in {"add": "+", "sub": "-", "mul": "*", "div": "/"}.items()},
    **{name: f"{{0}} {sign} {{1}}" for name, sign in zip(COMPARISONS, "> < >= <= == !=".split(), strict=True)},
    **{name: f"{{0}} {sign} {{1}}" for name, sign in {"and": "&&", "or": "||", "xor": "!="}.items()},
    **{name: f"{C_NAMES.get(name, name)}({{0}})" for name in ROUNDED},
    "minimum": "{0} < {1} || {0} != {0} ? {0} : {1}",
    "maximum": "{0} > {1} || {0} != {0} ? {0} : {1}",
    "neg": "-{0}",
    "not": "!{0}",
    "select": "{0} ? {1} : {2}",
}
"""Operations that are expressions, with their operands in braces; others are calls of the C library."""
Inputs = Mapping[tuple[str, int], str]
Outputs = Sequence[tuple[str, int]]


class CSource:
    """The functions of a C file.

    Args:
        weights: the weights of the programs in their order, each with a name for a comment.
    """

    def __init__(self, weights: Sequence[tuple[str, Sequence[float]]] = ()):
        self.functions: list[str] = []
        self._tables: dict[str, str] = {}
        self._weights = weights

    def add(self, head: str, program: Program, inputs: Inputs, outputs: Outputs) -> None:
        """Add a function that reads all its inputs before it writes an output, so that both may be one array.

        Args:
            head: its declaration without the semicolon.
            program: the program.
            inputs: C expression of each input, by name and position.
            outputs: places that are written, in C, with the numbers that they receive.
        """
        values = [value for _, value in outputs]
        needed, writer = [program.operations[i] for i in program.needed(values)], CWriter(self._tables)
        names = {o.attributes: f"{o.attributes[0]}_{o.attributes[1]}" for o in needed if o.name == "input"}
        writer.lines += [f"const double {name} = {inputs[key]};" for key, name in names.items()]
        operands = Lowering(program, writer, names, "weights").write(values)
        writer.lines += [f"{place} = {x};" for (place, _), x in zip(outputs, operands, strict=True)]
        self.write(head, writer.lines)

    def write(self, head: str, lines: Sequence[str]) -> None:
        """Add a function of given statements."""
        text = "\n".join(f"    {line}" for line in lines)
        parameters = re.findall(r"(\w+)(?=[,)])", head)
        unread = "".join(f"    (void){p};\n" for p in parameters if not re.search(rf"\b{p}\b", text))
        self.functions.append(f"{head}\n{{\n{unread}{text}\n}}\n")

    def text(self) -> str:
        """The constants and the functions."""
        functions = "\n".join(self.functions)
        weights = [f"/* {name} */\n{_wrapped(x)}" for name, x in self._weights if x] if "weights[" in functions else []
        tables = [_array(name, text) for text, name in self._tables.items()]
        return "\n".join([*([_array("weights", ",\n".join(weights))] if weights else []), *tables, functions])


class CWriter:
    """Writes a lowered program in C99, one realisation; it is a :class:`~rt_torchrl.programs.lowering.Writer`.

    Args:
        tables: names of the constant arrays of the file, by their content.
    """

    def __init__(self, tables: dict[str, str]):
        self.lines: list[str] = []
        self._tables = tables
        self._count, self._depth = 0, 0

    def _new(self, kind: str, text: str) -> str:
        self._count += 1
        self._emit(f"{kind} v{self._count}{text};")
        return f"v{self._count}"

    def _emit(self, line: str) -> None:
        self.lines.append("    " * self._depth + line)

    def constant(self, number: float, *, truth: bool) -> str:
        return str(int(number)) if truth else literal(number)

    def compute(self, name: str, *operands: str, truth: bool = False) -> str:
        text = FORMS[name].format(*operands) if name in FORMS else f"{name}({', '.join(operands)})"
        if self._depth:  # what a loop computes is read once
            return f"({text})"
        return self._new("const int" if truth else "const double", f" = {text}")

    def table(self, numbers: Sequence[float]) -> str:
        return self._tables.setdefault(_wrapped(numbers), f"table_{len(self._tables)}")

    def local(self, size: int) -> str:
        return self._new("double", f"[{size}]")

    def index(self, base: int, terms: Sequence[tuple[int, str]]) -> str:
        summands = []
        for stride, i in terms:
            if i.isdigit():
                base += stride * int(i)
            else:
                summands.append(i if stride == 1 else f"{stride} * {i if i.isidentifier() else f'({i})'}")
        return " + ".join([*summands, *([str(base)] if base or not summands else [])])

    def load(self, array: str, index: str, *, shared: bool = False) -> str:
        return f"{array}[{index}]"

    def store(self, array: str, index: str, operand: str) -> None:
        self._emit(f"{array}[{index}] = {operand};")

    def look_up(self, array: str, place: str, offset: int, *, shared: bool) -> str:
        return self._new("const double", f" = {array}[{self.index(offset, [(1, f'(int){place}')])}]")

    @contextmanager
    def loop(self, count: int) -> Iterator[str]:
        if count == 1:
            yield "0"
            return
        self._count += 1
        index = f"i{self._count}"
        self._emit(f"for (int {index} = 0; {index} < {count}; ++{index}) {{")
        self._depth += 1
        yield index
        self._depth -= 1
        self._emit("}")


def literal(number: float) -> str:
    """A number in C, which is read back to the bit."""
    if not math.isfinite(number):
        return "NAN" if math.isnan(number) else "INFINITY" if number > 0 else "(-INFINITY)"
    return f"({number!r})" if math.copysign(1.0, number) < 0 else repr(number)


def _wrapped(numbers: Sequence[float]) -> str:
    text = ", ".join(literal(x).strip("()") for x in numbers)
    return textwrap.indent("\n".join(textwrap.wrap(text, WIDTH, break_on_hyphens=False)), "    ")


def _array(name: str, content: str) -> str:
    return f"static const double {name}[] = {{\n{content}\n}};\n"
