"""The architecture of a module: what it is apart from its weights."""

from typing import Any

from torch import Tensor, nn


def same_architecture(first: nn.Module, second: nn.Module) -> bool:
    """Whether two modules with the same weights are the same function: same submodules, settings and weight shapes.

    Shapes alone do not tell: perceptrons with different activations have weights of the same shapes.
    """
    return _structure(first) == _structure(second)


def _structure(module: nn.Module) -> list[tuple[Any, ...]]:
    """Class and settings of every submodule, and the shapes of what its state dict holds."""
    parts = [(name, type(part), part.extra_repr(), _settings(part)) for name, part in module.named_modules()]
    return [*parts, *((name, value.shape) for name, value in module.state_dict().items())]


def _settings(module: nn.Module) -> dict[str, Any]:
    """Attributes that are neither weights nor submodules, such as an activation or a depth."""
    values = {name: value for name, value in vars(module).items() if not name.startswith("_") and name != "training"}
    return {name: value.tolist() if isinstance(value, Tensor) else value for name, value in values.items()}
