"""What an export is made of and compared with: samples of signals, a sound copy of the policy, greatest differences."""

import copy
import math
from collections.abc import Sequence
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal, bounds

OBSERVATIONS = 1000
SEED = 20_250_131
"""Seed of the observations, which is the same for every export and is used in no training."""
Module = TypeVar("Module", bound=nn.Module)


def sample_observations(signals: Sequence[Signal], count: int) -> Float[Tensor, "{count} n_o"]:
    """Random observations, the first of which is as near to zero as the ranges allow.

    A signal with two bounds is uniform over its range. Another one is normal with a deviation drawn from 0.1 ... 30,
    and clipped to a bound that it has. Observations are scaled to order one, so that these numbers reach the middle of
    a policy and its saturated ends.
    """
    generator, shape = torch.Generator().manual_seed(SEED), (count, len(signals))
    uniform, exponent = torch.rand(2, *shape, generator=generator, dtype=torch.float64)
    unbounded = torch.randn(shape, generator=generator, dtype=torch.float64) * 0.1 * 300.0**exponent
    low, high = bounds(signals)
    samples = torch.where((high - low).isfinite(), low + (high - low) * uniform, unbounded.clamp(low, high))
    samples[0] = torch.zeros_like(low).clamp(low, high)
    return samples


def frozen(module: Module) -> Module:
    """A copy of a module on the CPU, in evaluation mode, whose weights share no memory and take no gradients."""
    module = copy.deepcopy(module).cpu().eval().requires_grad_(False)
    for weight in module.parameters():
        weight.data = weight.data.clone()
    return module


def detached(policy: nn.Module, plant: Plant) -> nn.Module:
    """A copy of a policy from :func:`frozen`, after a check that it fits the plant.

    Raises:
        ValueError: if the policy does not map the plant's observations to its actions in double precision, or gives two
            actions for one observation.
    """
    policy = frozen(policy)
    name, observations = type(policy).__name__, sample_observations(plant.observations, 3)
    if type(policy).forward is nn.Module.forward:
        raise ValueError(
            f"{name} has no forward(observation), as classical and predictive controllers have none, which act from "
            "states, inputs and a memory; only a policy, a function of the observation, can be exported."
        )
    try:
        actions, again = policy(observations), policy(observations)
        kind, shape = actions.dtype, tuple(actions.shape)
    except Exception as error:  # any error of the user's module
        raise ValueError(
            f"policy {name} cannot take float64 observations of shape {tuple(observations.shape)} of plant "
            f"{plant.name!r}: {error}"
        ) from error
    if shape != (3, len(plant.actions)) or kind != torch.float64:
        raise ValueError(
            f"policy {name} returns {kind} {shape} for 3 observations of plant {plant.name!r}; "
            f"it must return torch.float64 (3, {len(plant.actions)}). A module becomes double by .double()."
        )
    if not torch.allclose(actions, again, rtol=0.0, atol=0.0, equal_nan=True):
        raise ValueError(
            f"policy {name} gives two actions for one observation, by random numbers or a memory; only a function of "
            "the observation alone can be exported."
        )
    return policy


def action_sizes(plant: Plant, actions: Float[Tensor, "n n_a"]) -> Float[Tensor, " n_a"]:
    """The ranges of the actions; of an action without range, its greatest size."""
    low, high = bounds(plant.actions)
    return torch.where((high - low).isfinite(), high - low, sizes(actions))


def sizes(values: Float[Tensor, "n m"]) -> Float[Tensor, " m"]:
    """The greatest finite size of every column."""
    finite = values.abs().nan_to_num(nan=0.0, posinf=0.0)
    return finite.amax(0).clamp(min=torch.finfo(torch.float64).tiny)


def require_close(
    values: Float[Tensor, "n m"],
    expected: Float[Tensor, "n m"],
    of: Float[Tensor, "*#n m"],
    tolerance: float,
    signals: Sequence[Signal],
    what: str,
) -> float:
    """The greatest difference of an export's values from the original ones, as a share of the signals' sizes.

    Args:
        values: values of the export.
        expected: values of what it was made of.
        of: sizes of the signals, perhaps of each row.
        tolerance: greatest difference that is allowed.
        signals: the signals, for the message.
        what: name of the export.

    Raises:
        ValueError: if the tolerance is exceeded.
    """
    equal = (values == expected) | (values.isnan() & expected.isnan())
    errors = torch.where(equal, 0.0, ((values - expected).abs() / of).nan_to_num(nan=math.inf))
    if errors.max() > tolerance:
        row, column = divmod(int(errors.argmax()), len(signals))
        raise ValueError(
            f"{what} differs from the original by {errors.max().item():.2g} of the range or size of "
            f"{signals[column].name!r} in sample {row}; at most {tolerance:g} is allowed, and nothing was written. No "
            "result may depend on the batch as a whole."
        )
    return errors.max().item()
