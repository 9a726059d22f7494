"""Save a training after any episode and go on with it later, to the bit."""

from pathlib import Path
from typing import Any

import torch

from rt_torchrl.twinning.algorithm import ReinforcementTwinning

FORMAT = 2


def state_of(algorithm: ReinforcementTwinning) -> dict[str, Any]:
    """Everything that the next episode depends on."""
    return {
        "format": FORMAT,
        "plant": algorithm.twin.plant.name,
        "episodes_done": algorithm.episodes_done,
        "policies": {role: policy.state_dict() for role, policy in algorithm.policies.items()},
        "closure": algorithm.twin.closure.state_dict(),
        "loss": algorithm.model_free.loss.state_dict(),
        "critic_optimiser": algorithm.model_free.critic_optimiser.state_dict(),
        "actor_optimiser": algorithm.model_free.actor_optimiser.state_dict(),
        "assimilation": algorithm.assimilation.descent.state_dict(),
        "damping": algorithm.assimilation.second_order.damping,
        "model_based": algorithm.model_based.descent.state_dict(),
        "long_term": algorithm.long_term.state_dict(),
        "short_term": list(algorithm.short_term),
        "processes": list(algorithm.processes),
        "switch": (algorithm.switch.live, algorithm.switch.worse_count, algorithm.switch.stall_count),
        "generator": algorithm.generator.get_state(),
        "real_system": algorithm.env.state_dict(),
    }


def restore(algorithm: ReinforcementTwinning, state: dict[str, Any]) -> None:
    """Put an algorithm, built with the same configuration, into a saved state.

    Raises:
        ValueError: if the state is of another plant, or its weights do not fit.
    """
    name = algorithm.twin.plant.name
    if state["plant"] != name:
        raise ValueError(f"the checkpoint is of plant {state['plant']!r}, this training of {name!r}; use its recipe.")
    try:
        for role, policy in algorithm.policies.items():
            policy.load_state_dict(state["policies"][role])
        algorithm.twin.closure.load_state_dict(state["closure"])
        algorithm.model_free.loss.load_state_dict(state["loss"])
    except (RuntimeError, KeyError, ValueError) as error:  # of torch and of tensordict
        raise ValueError(
            f"the checkpoint's weights do not fit this training of {name!r}; start with the options it was started "
            f"with (see its config.json). {error}"
        ) from error
    algorithm.model_free.critic_optimiser.load_state_dict(state["critic_optimiser"])
    algorithm.model_free.actor_optimiser.load_state_dict(state["actor_optimiser"])
    algorithm.assimilation.descent.load_state_dict(state["assimilation"])
    algorithm.assimilation.second_order.damping = state["damping"]
    algorithm.model_based.descent.load_state_dict(state["model_based"])
    algorithm.long_term.load_state_dict(state["long_term"])
    for memory in ("short_term", "processes"):
        getattr(algorithm, memory).clear()
        getattr(algorithm, memory).extend(state[memory])
    algorithm.switch.live, algorithm.switch.worse_count, algorithm.switch.stall_count = state["switch"]
    algorithm.generator.set_state(state["generator"])
    algorithm.env.load_state_dict(state["real_system"])
    algorithm.episodes_done = state["episodes_done"]


def save(path: Path, algorithm: ReinforcementTwinning, episodes: list[dict[str, Any]]) -> None:
    """Write a checkpoint; an interrupt while writing leaves the one before intact."""
    partial = path.with_suffix(".partial")
    torch.save({**state_of(algorithm), "episodes": episodes}, partial)
    partial.replace(path)


def load(path: Path, algorithm: ReinforcementTwinning) -> list[dict[str, Any]]:
    """Restore a checkpoint and return the records of its episodes.

    Raises:
        ValueError: if there is none at ``path``, it is of another format or plant, or its weights do not fit.
    """
    if not path.is_file():
        raise ValueError(f"there is no checkpoint {path} to resume from; start without --resume.")
    # Written by save(); holds records and processes beside weights, which weights_only would refuse.
    state = torch.load(path, weights_only=False, map_location=algorithm.generator.device)
    if state.get("format") != FORMAT:
        raise ValueError(f"{path} has checkpoint format {state.get('format')}; this version reads format {FORMAT}.")
    restore(algorithm, state)
    return state["episodes"]
