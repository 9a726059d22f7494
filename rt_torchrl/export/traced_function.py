"""A function of vectors as a program, with the weights of the modules that it uses."""

import contextlib
import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from rt_torchrl.programs.program import Program, UntraceableError
from rt_torchrl.programs.rules import new_tracer
from rt_torchrl.programs.tracer import Tracer

REMEDY = "Write it with arithmetic of torch in float64; the formats pt2 and onnx take more of a policy than C does."


Module = TypeVar("Module", bound=nn.Module)


class TracedFunction(NamedTuple):
    """A program with the values of its outputs.

    Args:
        program: the program; its inputs have the name of an argument and a position.
        outputs: values of every output.
    """

    program: Program
    outputs: dict[str, list[int]]

    def reads(self, name: str) -> set[int]:
        """The positions of an argument that the outputs depend on."""
        needed = self.program.needed(value for values in self.outputs.values() for value in values)
        found = [self.program.operations[value] for value in needed]
        return {o.attributes[1] for o in found if o.name == "input" and o.attributes[0] == name}


def frozen(module: Module) -> Module:
    """A copy of a module on the CPU, in evaluation mode, whose weights share no memory and take no gradients."""
    module = copy.deepcopy(module).cpu().eval().requires_grad_(False)
    for weight in module.parameters():
        weight.data = weight.data.clone()
    return module


def traced(
    what: str,
    function: Callable[..., Mapping[str, Tensor]],
    arguments: Mapping[str, Tensor],
    modules: Sequence[nn.Module] = (),
    *,
    prepare: Callable[[Tracer], None] | None = None,
) -> TracedFunction:
    """Trace a function of vectors, one realisation.

    Args:
        what: name of the function, for messages.
        function: function of tensors that returns tensors by name.
        arguments: example of every argument, with one realisation.
        modules: modules from :func:`frozen` with weights, in the order in which the C file holds them.
        prepare: called with the tracer before the function is.

    Raises:
        UntraceableError: if the function cannot become a program; the message names the reason and the line.
    """
    tracer, entered = new_tracer(), list[str]()
    given = {name: value.clone() for name, value in arguments.items()}
    try:
        for name, value in given.items():
            tracer.input(value, name)
        for weight in (weight for module in modules for weight in module.parameters()):
            tracer.weight(weight)
        if prepare is not None:
            prepare(tracer)
        with torch.no_grad(), tracer.following(), _noted(modules, entered):
            found = function(**given)
        outputs = {name: tracer.outputs(value) for name, value in found.items()}
    except UntraceableError as error:
        layer = f"layer {entered[-1]} of " if entered else ""
        raise UntraceableError(f"{layer}{what} cannot be written in C: {error}. {REMEDY}") from error
    return TracedFunction(tracer.program, outputs)


@contextlib.contextmanager
def _noted(modules: Sequence[nn.Module], entered: list[str]) -> Iterator[None]:
    """A context in which ``entered`` holds the names of the layers whose call has begun and not ended."""
    hooks = []
    for path, layer in (pair for module in modules for pair in module.named_modules() if pair[0]):
        name = f"{path!r} ({type(layer).__name__})"
        hooks.append(layer.register_forward_pre_hook(lambda *_, name=name: entered.append(name)))
        hooks.append(layer.register_forward_hook(lambda *_: entered.pop() and None))
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()


def weights_of(modules: Mapping[str, nn.Module]) -> list[tuple[str, list[float]]]:
    """The weights of modules in the order in which :func:`traced` numbers them, each with a name."""
    return [
        (f"{role} {name} {tuple(weight.shape)}", weight.detach().flatten().tolist())
        for role, module in modules.items()
        for name, weight in module.named_parameters()
    ]
