"""A step of the algorithm, the report of an episode, and the state and the architecture of parts."""

import math
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector

from rt_torchrl.trajectories.trajectory import Trajectory

Report = TypeVar("Report", bound=TensorDictBase)


class Step(TensorDictModuleBase):
    """A step of the algorithm: it reads ``in_keys`` of the episode, writes ``out_keys`` and what it reports.

    Args:
        parts: what lasts from episode to episode and belongs to this step, by the name that a user knows it by. Each
            has ``state_dict`` and ``load_state_dict``.
    """

    def __init__(self, **parts: Any):
        super().__init__()
        self.parts = parts

    def get_extra_state(self) -> dict[str, Any]:
        """The state of every part, in tensors and plain containers."""
        return {name: part.state_dict() for name, part in self.parts.items()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Give every part its state.

        Raises:
            ValueError: if a state does not fit its part, with the name of the part.
        """
        for name, part in self.parts.items():
            try:
                part.load_state_dict(state[name])
            # Torch, tensordict and environments each have errors of their own for what does not fit.
            except (RuntimeError, LookupError, ValueError, TypeError, AttributeError) as error:
                raise ValueError(f"the saved state of {name} does not fit: {error}") from error


def metrics(*reasons: str, **values: float | Tensor | str) -> TensorDict:
    """A report with scalars in double precision, texts and, if there are reasons, the entry ``reason``.

    Args:
        reasons: reasons for refusals, one sentence each.
        values: the scalars and texts, by name.
    """
    # A report is on the CPU, because it is read there and its numbers come from any device.
    double = partial(torch.as_tensor, dtype=torch.float64, device="cpu")
    report = TensorDict({key: double(x).detach() for key, x in values.items() if not isinstance(x, str)})
    for key, text in values.items():
        if isinstance(text, str):
            report.set_non_tensor(key, text)
    return report.set_non_tensor("reason", "; ".join(reasons)) if reasons else report


def merged(report: Report, other: TensorDictBase) -> Report:
    """The report with the entries of ``other`` added; the reasons of both stay."""
    reasons = [part["reason"] for part in (report, other) if "reason" in part]
    report.update(other)
    return report.set_non_tensor("reason", "; ".join(reasons)) if reasons else report


def in_words(cost: float, digits: int = 3) -> str:
    """A cost as people read it; one that is infinite or not a number is said in words.

    Args:
        cost: the cost, infinite where the twin diverges, and not a number where nobody has computed it.
        digits: number of significant digits.
    """
    if math.isnan(cost):
        return "not computed"
    return f"{cost:.{digits}g}" if math.isfinite(cost) else "diverges"


def weight_change(module: nn.Module, earlier: Tensor) -> Tensor:
    """The relative change ‖w − w_earlier‖/‖w‖ of a module's weights since they were the vector ``earlier``."""
    now = parameters_to_vector(module.parameters()).detach()
    return (now - earlier).norm() / now.norm()


def same_architecture(first: nn.Module, second: nn.Module) -> bool:
    """Whether two modules with the same weights are the same function: same submodules, settings and weight shapes.

    Shapes alone do not tell: perceptrons with different activations have weights of the same shapes.
    """
    return _structure(first) == _structure(second)


def _structure(module: nn.Module) -> list[tuple[Any, ...]]:
    """Class and settings of every submodule, such as an activation, and the shapes of what its state dict holds."""
    parts = list[tuple[Any, ...]]()
    for name, part in module.named_modules():
        values = {key: value for key, value in vars(part).items() if not key.startswith("_") and key != "training"}
        settings = {key: v.tolist() if isinstance(v, Tensor | np.ndarray) else v for key, v in values.items()}
        parts.append((name, type(part), part.extra_repr(), settings))
    return [*parts, *((name, value.shape) for name, value in module.state_dict().items())]


def record_of(episode: TensorDictBase) -> Trajectory:
    """The record of an episode as a trajectory."""
    record = episode["record"]
    return Trajectory(record["states"], record["actions"], record["exogenous"], float(record["start"]))
