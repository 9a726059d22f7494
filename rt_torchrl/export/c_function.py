"""The translation of a traced policy's graph into the statements of a C function.

A policy has three kinds of operators. An operator that does not depend on the observation is computed during the
translation. An operator that only moves elements is applied to their places, and needs no C. Every other operator
becomes a loop, with an expression for each element (:data:`.c_operators.ELEMENTWISE`) or a sum of products (``mm``).
"""

from typing import Any

import torch
from torch import Tensor
from torch.export import ExportedProgram, default_decompositions
from torch.fx import Node

from rt_torchrl.export.c_body import CBody, Elements, counted
from rt_torchrl.export.c_operators import (
    CHECKS,
    DECOMPOSED,
    ELEMENTWISE,
    FILLING,
    FUNCTIONS,
    MOVING,
    READ_ONCE,
    literal,
)
from rt_torchrl.export.program import layer_of


class CFunction:
    """Translates the graph of a policy, operator by operator; the statements are in :attr:`body`.

    Args:
        program: traced policy of one observation, (1, n_o) -> (1, n_a).
        policy: name of the policy, for messages.

    Raises:
        ValueError: if an operator has no C form here; the message names the layer.
    """

    def __init__(self, program: ExportedProgram, policy: str):
        self.policy, self.body = policy, CBody()
        self._values: dict[Node, Any] = {}
        self._labels: dict[Node, str] = {}
        self._inlined: dict[Node, str] = {}
        table = default_decompositions()
        table.update(DECOMPOSED)
        program = program.run_decompositions(table)
        held = {**program.constants, **program.state_dict}
        targets = {spec.arg.name: spec.target for spec in program.graph_signature.input_specs}
        for node in program.graph.nodes:
            if node.op == "placeholder":
                target, shape = targets[node.name], node.meta["val"].shape
                self._labels[node] = target or "observation"
                self._values[node] = held[target].detach() if target else Elements("observation", counted(shape))
            elif node.op == "output":
                shape = node.args[0][0].meta["val"].shape
                self.body.finish(self._operand(node.args[0][0], shape), shape.numel())
            else:
                self._labels[node] = "_".join([*(self._labels[n] for n in node.all_input_nodes), _name(node)])
                self._values[node] = self._computed(node)

    def _computed(self, node: Node) -> Any:
        operator, inputs, keywords = _call(node)
        args, kwargs = torch.fx.node.map_arg((inputs, keywords), self._values.get)
        varying = [n for n in node.all_input_nodes if _varies(self._values[n])]
        name, value = _name(node), node.meta.get("val")
        if node.op != "call_function":
            raise self._refusal(node, node.op)
        if not varying or name in CHECKS:
            return None if name in CHECKS else operator(*args, **kwargs)
        if name in FILLING:
            return operator(torch.zeros(args[0].places.shape, dtype=torch.float64), *args[1:], **kwargs)
        if isinstance(value, Tensor) and value.dtype not in (torch.float64, torch.bool):
            raise self._refusal(node, f"{name} in {value.dtype}")
        self.body.begin(node.name, layer_of(node, self.policy).partition(" of policy ")[0])
        if name in ("mm", "bmm", "addmm", "baddbmm"):
            return self._product(*map(self._as_elements, inputs), **kwargs)
        if name == "cat":
            return self.body.join([self._as_elements(part) for part in inputs[0]], *args[1:], **kwargs)
        if len(varying) == 1 and (name in MOVING or (name == "_to_copy" and self._keeps_values(node))):
            return _moved(node, *args, **kwargs)
        if name in ("sum", "mean"):
            return self._reduced(name == "mean", *args)
        if name in ELEMENTWISE and not kwargs.get("rounding_mode"):
            return self._elementwise(node, name)
        raise self._refusal(node, name)

    def _refusal(self, node: Node, operation: str) -> ValueError:
        return ValueError(
            f"{layer_of(node, self.policy)} uses {operation!r}, which has no C form here. Export to pt2 "
            "(export_program) or ONNX (export_onnx) instead, or build the policy of Linear layers, activations such as "
            "Tanh, ReLU or SiLU, LayerNorm and arithmetic, in float64."
        )

    def _as_elements(self, argument: Node) -> Elements:
        """The elements of a tensor in an array; a constant becomes an array of the file."""
        value = self._values[argument]
        return value if isinstance(value, Elements) else self.body.constant(value, self._labels[argument])

    @staticmethod
    def _keeps_values(node: Node) -> bool:
        """Whether a cast changes no value, because it keeps the type or casts a truth value."""
        _, (source, *_), _ = _call(node)
        return source.meta["val"].dtype in (node.meta["val"].dtype, torch.bool)

    def _operand(self, argument: Any, shape: torch.Size) -> Any:
        """The i-th element of an operand, broadcast to a shape; other operands than tensors and numbers stay."""
        if not isinstance(argument, Node):
            return literal(argument) if isinstance(argument, (bool, int, float)) else argument
        if argument in self._inlined:
            return self._inlined[argument]
        value = self._values[argument]
        if isinstance(value, Tensor) and value.numel() and (value == value.flatten()[0]).all():
            return literal(value.flatten()[0].item())
        return self.body.read(self._as_elements(argument), shape)

    def _elementwise(self, node: Node, name: str) -> Elements:
        shape, (_, inputs, given) = node.meta["val"].shape, _call(node)
        keywords = {key: self._operand(argument, shape) for key, argument in given.items()}
        expression = ELEMENTWISE[name](*(self._operand(argument, shape) for argument in inputs), **keywords)
        if not self._can_inline(node, shape):
            return self.body.assign(expression, shape)
        whole = name in FUNCTIONS or next(iter(node.users)).op == "output"
        self._inlined[node] = expression if whole else f"({expression})"
        return self.body.later(shape)

    @staticmethod
    def _can_inline(node: Node, shape: torch.Size) -> bool:
        """Whether the expression has one reader, which writes it down once, element by element."""
        readers = list(node.users)
        if len(readers) != 1 or readers[0].all_input_nodes.count(node) != 1:
            return False
        if readers[0].op == "output":
            return True
        return _name(readers[0]) in READ_ONCE and readers[0].meta["val"].shape == shape

    def _product(self, *factors: Elements, beta: float = 1, alpha: float = 1) -> Elements:
        """A matrix product; the first of three arguments is added to it."""
        left, right = factors[-2:]
        shape = (*left.places.shape[:-1], right.places.shape[-1])
        start = literal(0.0)
        if len(factors) == 3:
            start = f"{literal(beta)} * {self.body.read(factors[0], shape)}"
        terms = (left.moved(left.places.unsqueeze(-2)), right.moved(right.places.mT.unsqueeze(-3)))
        return self.body.sum(terms, shape, start=start, scale=literal(alpha))

    def _reduced(self, mean: bool, source: Elements, dims: list[int] | None = None, keepdim: bool = False) -> Elements:
        places = source.places
        dims = [d % places.dim() for d in dims or range(places.dim())]
        kept = [d for d in range(places.dim()) if d not in dims]
        terms = places.permute(*kept, *dims).flatten(len(kept))
        scale = literal(1.0 / terms.shape[-1] if mean else 1.0)
        result = self.body.sum([source.moved(terms)], terms.shape[:-1], scale=scale)
        return result.moved(result.places.view(places.sum(dims, keepdim=True).shape)) if keepdim else result


def _call(node: Node) -> tuple[Any, tuple[Any, ...], dict[str, Any]]:
    """The operator and its arguments; torch declares each as anything that a graph can hold."""
    return node.target, node.args, node.kwargs


def _name(node: Node) -> str:
    """The name of the operator, such as add for aten.add.Tensor."""
    return getattr(node.target, "__name__", str(node.target)).partition(".")[0]


def _varies(value: Any) -> bool:
    """Whether a value depends on the observation."""
    return isinstance(value, Elements) or (isinstance(value, tuple) and any(map(_varies, value)))


def _moved(node: Node, source: Any, *rest: Any, **kwargs: Any) -> Any:
    """The result of an operator that is applied to the places of the elements."""
    if isinstance(source, tuple):  # of split or unbind, to be picked from
        return source[rest[0]]
    if _name(node) == "_to_copy":
        return source
    operator, _, _ = _call(node)
    moved = operator(source.places, *rest, **kwargs)
    return source.moved(moved) if isinstance(moved, Tensor) else tuple(map(source.moved, moved))
