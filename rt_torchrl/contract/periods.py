"""A check that a whole turn of a periodic state changes nothing."""

from collections.abc import Iterator

import torch

from rt_torchrl.contract.calls import Calls
from rt_torchrl.contract.signals import GROUPS
from rt_torchrl.plants.signal import differences

TOLERANCE = 1e-6
"""Greatest relative change of a result; the rounding of an angle plus one turn is far smaller."""


@torch.no_grad()
def periods(calls: Calls) -> Iterator[str]:
    """Periodic signals that are no states, and methods whose results change with a turn of a periodic state."""
    plant, found = calls.plant, calls.arguments
    for group in GROUPS:
        for signal in getattr(plant, group):
            if signal.periodic and group != "states":
                yield f"{group}: {signal.name!r} is periodic; only a state can be: take its cosine and sine instead."
    for k, signal in enumerate(plant.states):
        if not signal.periodic:
            continue
        turned = found["state"].clone()
        turned[..., k] += signal.period
        for method in calls.methods():
            if "state" not in method.takes:
                continue
            pairs = zip(method.outputs(found), method.outputs(found | {"state": turned}), strict=True)
            for name, (first, second) in zip(method.gives, pairs, strict=True):
                gap = differences(plant.states, second, first) if name == "state" else second - first
                if (gap.abs() > TOLERANCE * (1.0 + first.abs())).any():
                    yield (
                        f"{method.name}: its {name} changes by up to {gap.abs().max():.4g} when state {signal.name!r} "
                        f"turns by its period {signal.period:g} {signal.unit}; use its cosine and sine, or the short "
                        "way round."
                    )
