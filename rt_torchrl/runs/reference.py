"""What the costs of a run are compared with: the best of its class of policies, the limit, and predictive control."""

from collections.abc import Callable
from typing import Any

import torch
from torch import nn

from rt_torchrl.evaluation.limits import (
    FOR_PERCEPTRONS,
    Contender,
    LimitConfig,
    exact_optimum,
    few_starts,
    limit,
    predictive,
)
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.runs.run_config import RunConfig


def found(
    config: RunConfig,
    unseen: UnseenEpisodes,
    make_policy: Callable[[torch.Generator], nn.Module],
    better: nn.Module,
) -> dict[str, Any]:
    """The entry ``reference`` of the summary; nothing without the option ``reference``.

    Args:
        config: options of the run.
        unseen: the unseen episodes.
        make_policy: function that draws a random policy of the class.
        better: the better policy of the training.
    """
    if not config.reference:
        return {}
    optimum = exact_optimum(unseen, make_policy, **(FOR_PERCEPTRONS if config.policy == "mlp" else {}))
    known, cost = config.limit() if config.limit_episodes else None, unseen.control_costs(better).mean().item()
    compared = {
        "J_a": optimum.cost,
        "J_a_of_each_start": optimum.costs,
        "better_over_reference": cost / optimum.cost,
    }
    if known is not None:
        few = unseen.first(config.limit_episodes)
        compared |= {"limit": beside_the_limit(few, known, {"optimum": optimum.policy, "better": better})}
    return {"reference": compared}


def beside_the_limit(episodes: UnseenEpisodes, known: LimitConfig, policies: dict[str, nn.Module]) -> dict[str, Any]:
    """The limit, and what policies and model predictive control cost over it on the same episodes.

    Args:
        episodes: the episodes.
        known: how the limit is computed.
        policies: the policies by name.
    """
    best = limit(episodes, few_starts(episodes, known), hold=known.hold, config=known.descent)
    costs = {name: episodes.control_costs(policy).mean().item() for name, policy in policies.items()}
    found = {"episodes": len(best.costs), "J_a": best.mean, **entry(best)}
    found |= {f"{name}_over_limit": cost / best.mean for name, cost in costs.items()}
    if known.window is None:
        return found
    planned = predictive(episodes, known.window)
    return found | {"mpc": {"J_a": planned.mean, "over_limit": planned.mean / best.mean, **entry(planned)}}


def entry(contender: Contender) -> dict[str, Any]:
    """The plant's own quantities, times and details of a contender."""
    times = {} if contender.milliseconds is None else {"milliseconds": contender.milliseconds}
    return {"merit": contender.merit, **times, **contender.details}
