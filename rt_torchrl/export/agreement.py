"""The comparison of an exported policy with the original."""

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal, bounds

TOLERANCE = 1e-6
"""Greatest difference allowed, as a share of the action's range; computation in double precision needs 1e-12."""
OBSERVATIONS = 1000
SEED = 20_250_131
"""Seed of the observations, which is the same for every export and is used in no training."""


def sample_observations(signals: Sequence[Signal], count: int, seed: int = SEED) -> Float[Tensor, "{count} n_o"]:
    """Random observations, the first of which is as near to zero as the ranges allow.

    A signal with two bounds is uniform over its range. A signal without bounds is normal with a deviation drawn from
    0.1 ... 30; with one bound, the absolute value of such a number is added to the bound or subtracted from it.
    Observations are scaled to order one, so that these numbers reach the middle of a policy and its saturated ends.
    """
    generator, columns = torch.Generator().manual_seed(seed), []
    for signal in signals:
        like: dict[str, Any] = {"generator": generator, "dtype": torch.float64}
        uniform, normal, exponent = torch.rand(count, **like), torch.randn(count, **like), torch.rand(count, **like)
        unbounded = normal * 0.1 * 300.0**exponent
        if math.isfinite(signal.low) and math.isfinite(signal.high):
            column = signal.low + (signal.high - signal.low) * uniform
        elif math.isfinite(signal.low):
            column = signal.low + unbounded.abs()
        else:
            column = signal.high - unbounded.abs() if math.isfinite(signal.high) else unbounded
        column[0] = min(max(0.0, signal.low), signal.high)
        columns.append(column)
    return torch.stack(columns, -1)


def detached(policy: nn.Module, plant: Plant) -> nn.Module:
    """A copy of a policy on the CPU, in evaluation mode and without gradients, after a check that it fits the plant.

    Raises:
        ValueError: if the policy does not map the plant's observations to its actions in double precision, or if a call
            changes its buffers.
    """
    policy = copy.deepcopy(policy).cpu().eval().requires_grad_(False)
    name, n_o, n_a = type(policy).__name__, len(plant.observations), len(plant.actions)
    observations, before = sample_observations(plant.observations, 3), copy.deepcopy(dict(policy.named_buffers()))
    try:
        actions = policy(observations)
    except Exception as error:  # any error of the user's module
        raise ValueError(
            f"policy {name} cannot take float64 observations of shape (3, {n_o}) of plant {plant.name!r}: {error}"
        ) from error
    if not isinstance(actions, Tensor) or actions.shape != (3, n_a) or actions.dtype != torch.float64:
        found = f"{actions.dtype} {tuple(actions.shape)}" if isinstance(actions, Tensor) else type(actions).__name__
        raise ValueError(
            f"policy {name} returns {found} for 3 observations of plant {plant.name!r}; it must return torch.float64 "
            f"(3, {n_a}). A module in single precision becomes double by .double()."
        )
    changed = [buffer for buffer, value in policy.named_buffers() if not value.equal(before[buffer])]
    if changed:
        raise ValueError(
            f"policy {name} changes its buffers {', '.join(changed)} when it is called; only a function of the "
            "observation alone can be exported."
        )
    return policy


def require_agreement(
    policy: nn.Module, exported: Callable[[Float[Tensor, "n n_o"]], Tensor], plant: Plant, *, what: str
) -> float:
    """Compare an export with its policy on random observations, one, two and many at a time.

    Args:
        policy: the original policy.
        exported: function that computes what a user of the exported file would compute.
        plant: plant with the observations and the ranges of the actions.
        what: name of the exported thing, for the message.

    Returns:
        Greatest difference of an action, as a share of its range or, for an action without range, of its greatest size.

    Raises:
        ValueError: if the difference exceeds ``TOLERANCE``, or the policy's actions are not finite.
    """
    observations = sample_observations(plant.observations, OBSERVATIONS)
    with torch.no_grad():
        expected = policy(observations)
        found = torch.cat([exported(part) for part in observations.split([1, 2, OBSERVATIONS - 3])])
    if not expected.isfinite().all():
        worst = observations[(~expected.isfinite()).any(-1)][0].tolist()
        raise ValueError(f"policy {type(policy).__name__} gives actions that are not finite at observation {worst}.")
    errors = shares_of_range(found, expected, plant)
    if errors.max() > TOLERANCE:
        row, column = divmod(int(errors.argmax()), len(plant.actions))
        raise ValueError(
            f"{what} of policy {type(policy).__name__} differs from it by {errors.max().item():.2g} of the range of "
            f"{plant.actions[column].name!r} at observation {observations[row].tolist()}; at most {TOLERANCE:g} is "
            "allowed, and nothing was written. A policy must be a function of the observation alone: no random number, "
            "no memory, no use of the batch as a whole."
        )
    return errors.max().item()


def shares_of_range(
    found: Float[Tensor, "n n_a"], expected: Float[Tensor, "n n_a"], plant: Plant
) -> Float[Tensor, "n n_a"]:
    """Differences of actions over their ranges or, without a range, over their greatest sizes; infinite for NaN."""
    low, high = bounds(plant.actions)
    ranges = high - low
    size = torch.where(ranges.isfinite(), ranges, expected.abs().amax(0).clamp(min=torch.finfo(torch.float64).tiny))
    return ((found - expected).abs() / size).nan_to_num(nan=math.inf)
