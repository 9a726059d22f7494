r"""Policies of general use: any ``policy(observation) -> action`` with actions in physical units can replace them.

They saturate by the paper's smooth clip (eq. clip), which maps x = 0 to the middle of the range:

.. math:: \mathrm{clip}(x, a_{lo}, a_{hi}) = \tfrac12(\tanh x + 1)(a_{hi} - a_{lo}) + a_{lo}
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.signal import Signal, bounds


class SmoothClip(nn.Module):
    """The paper's smooth saturation to the ranges of the actions.

    Args:
        actions: the actions, each with a finite range.
        device: device of the ranges; torch's default if None.

    Raises:
        ValueError: if an action has no finite range.
    """

    def __init__(self, actions: Sequence[Signal], *, device: torch.device | None = None):
        super().__init__()
        self.low, self.high = map(nn.Buffer, bounds(actions, device=device))
        if not (self.low.isfinite() & self.high.isfinite()).all():
            raise ValueError(
                f"the ranges of {', '.join(f'{a.name} [{a.low}, {a.high}] {a.unit}' for a in actions)} must be finite: "
                "give each Signal a low and a high."
            )

    def forward(self, x: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_a"]:
        return 0.5 * (torch.tanh(x) + 1.0) * (self.high - self.low) + self.low


class SaturatedAffine(nn.Module):
    r"""One affine map per action through the smooth clip: :math:`a = \mathrm{clip}(We + b)`.

    Args:
        n_observations: number of observations.
        actions: the actions and their ranges.
        bias: whether b is learned; without b, zero error gives the middle of the range.
        weight_scale: standard deviation of the initial W; with zero the policy starts in the middle of the ranges.
        generator: source of the initial weights.
    """

    def __init__(
        self,
        n_observations: int,
        actions: Sequence[Signal],
        *,
        bias: bool = True,
        weight_scale: float = 0.1,
        generator: torch.Generator,
    ):
        super().__init__()
        self.linear = nn.Linear(n_observations, len(actions), bias=bias, dtype=torch.float64, device=generator.device)
        with torch.no_grad():
            self.linear.weight.normal_(0.0, weight_scale, generator=generator)
            if bias:
                self.linear.bias.zero_()
        self.clip = SmoothClip(actions, device=generator.device)

    def forward(self, observation: Float[Tensor, "*batch n_o"]) -> Float[Tensor, "*batch n_a"]:
        return self.clip(self.linear(observation))


class SaturatedMLP(nn.Module):
    r"""A multilayer perceptron through the smooth clip.

    The last layer's initial weights are a tenth of the others, so that the policy starts near the middle of the ranges.

    Args:
        n_observations: number of observations.
        actions: the actions and their ranges.
        hidden: width of each hidden layer.
        generator: source of the initial weights.
    """

    def __init__(
        self,
        n_observations: int,
        actions: Sequence[Signal],
        *,
        hidden: Sequence[int] = (32, 32),
        generator: torch.Generator,
    ):
        super().__init__()
        self.network = mlp(n_observations, hidden, len(actions), generator=generator)
        with torch.no_grad():
            self.network[-1].get_parameter("weight").mul_(0.1)
        self.clip = SmoothClip(actions, device=generator.device)

    def forward(self, observation: Float[Tensor, "*batch n_o"]) -> Float[Tensor, "*batch n_a"]:
        return self.clip(self.network(observation))


def mlp(
    n_inputs: int,
    hidden: Sequence[int],
    n_outputs: int,
    *,
    generator: torch.Generator,
    activation: type[nn.Module] = nn.Tanh,
) -> nn.Sequential:
    """A perceptron with smooth units (adjoints need derivatives), LeCun-normal weights and zero biases."""
    widths = (n_inputs, *hidden, n_outputs)
    if min(widths) < 1:
        raise ValueError(f"layer widths {widths} must all be at least 1.")
    layers: list[nn.Module] = []
    for i, (fan_in, fan_out) in enumerate(zip(widths, widths[1:], strict=False)):
        linear = nn.Linear(fan_in, fan_out, dtype=torch.float64, device=generator.device)
        with torch.no_grad():
            linear.weight.normal_(0.0, fan_in**-0.5, generator=generator)
            linear.bias.zero_()
        layers += [linear] if i == len(widths) - 2 else [linear, activation()]
    return nn.Sequential(*layers)
