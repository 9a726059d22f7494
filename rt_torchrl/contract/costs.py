"""Checks of the costs, and of the action that a step applies."""

from collections.abc import Iterator

import torch

from rt_torchrl.contract.calls import Calls


@torch.no_grad()
def costs(calls: Calls) -> Iterator[str]:
    """Violations in the signs of the costs, in the applied action of a step, and in commanding that action again."""
    plant, found = calls.plant, calls.arguments
    for method in calls.methods():
        if method.name in ("running_cost", "terminal_cost", "discrepancy"):
            (cost,) = method.outputs(found)
            if (cost < 0.0).any():
                k, b = (cost == cost.min()).nonzero()[0].tolist()
                yield (
                    f"{method.name}: is {cost.min():.4g} at state {found['state'][k, b].tolist()}; expected no "
                    "negative cost: add a constant, or penalise squares of errors."
                )
    size = 1e-9 * (1.0 + found["applied"].abs().amax((0, 1)))
    applied = plant.actuate(found["state"], found["command"])
    step = plant.step(found["t"], found["state"], found["command"], found["exogenous"], plant.closure)
    if ((step.applied - applied).abs() > size).any():
        yield (
            "step: its applied action is not what actuate(state, command) gives, by up to "
            f"{(step.applied - applied).abs().max():.4g}; call actuate in step, because trajectories report its action."
        )
    again = plant.actuate(found["state"], applied)
    if ((again - applied).abs() > size).any():
        yield (
            "actuate: an applied action that is commanded again from the same state becomes another one, by up to "
            f"{(again - applied).abs().max():.4g}; records hold applied actions, and the twin replays them as commands."
        )
