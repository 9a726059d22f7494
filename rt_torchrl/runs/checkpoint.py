"""Save a training after any episode and go on with it later, to the bit."""

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from rt_torchrl.runs.tensor_file import load_tensors, save_tensors
from rt_torchrl.trajectories.trajectory import Record
from rt_torchrl.twinning.algorithm import ReinforcementTwinning
from rt_torchrl.twinning.exogenous import ExogenousProcess
from rt_torchrl.twinning.memory import LongTermMemory

FORMAT = 3
PROCESS = ("mean", "covariance", "_low", "_high")
TREES = ("_sum_tree", "_min_tree")


def state_of(algorithm: ReinforcementTwinning) -> dict[str, Any]:
    """Everything that the next episode depends on: tensors, numbers and strings in dicts, lists and tuples."""
    return {
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
        "long_term": memory_state(algorithm.long_term),
        "short_term": [record._asdict() for record in algorithm.short_term],
        "processes": [{name: getattr(process, name) for name in PROCESS} for process in algorithm.processes],
        "switch": (algorithm.switch.live, algorithm.switch.worse_count, algorithm.switch.stall_count),
        "generator": algorithm.generator.get_state(),
        "real_system": algorithm.env.state_dict(),
    }


def restore(algorithm: ReinforcementTwinning, state: dict[str, Any]) -> None:
    """Put an algorithm, built with the same configuration, into a saved state.

    Raises:
        ValueError: if the state is of another plant, or does not fit.
    """
    name = algorithm.twin.plant.name
    if state.get("plant") != name:
        raise ValueError(
            f"the checkpoint is of plant {state.get('plant')!r}, this training of {name!r}; use its recipe."
        )
    try:
        _restore(algorithm, state)
    # What a part of another shape or kind raises depends on the part: torch, tensordict and environments differ.
    except (RuntimeError, LookupError, ValueError, TypeError, AttributeError) as error:
        raise ValueError(
            f"the checkpoint's weights do not fit this training of {name!r}; start with the options it was started "
            f"with (see its config.json). {type(error).__name__}: {error}"
        ) from error


def _restore(algorithm: ReinforcementTwinning, state: dict[str, Any]) -> None:
    device = algorithm.generator.device
    for role, policy in algorithm.policies.items():
        policy.load_state_dict(state["policies"][role])
    algorithm.twin.closure.load_state_dict(state["closure"])
    algorithm.model_free.loss.load_state_dict(state["loss"])
    algorithm.model_free.critic_optimiser.load_state_dict(state["critic_optimiser"])
    algorithm.model_free.actor_optimiser.load_state_dict(state["actor_optimiser"])
    algorithm.assimilation.descent.load_state_dict(state["assimilation"])
    algorithm.assimilation.second_order.damping = state["damping"]
    algorithm.model_based.descent.load_state_dict(state["model_based"])
    algorithm.long_term = restored_memory(algorithm, state["long_term"])
    algorithm.short_term.clear()
    algorithm.short_term.extend(
        Record(**{key: value.to(device) for key, value in entry.items()}) for entry in state["short_term"]
    )
    algorithm.processes.clear()
    algorithm.processes.extend(_process(entry, device) for entry in state["processes"])
    algorithm.switch.live, algorithm.switch.worse_count, algorithm.switch.stall_count = state["switch"]
    algorithm.generator.set_state(state["generator"])
    algorithm.env.load_state_dict(state["real_system"])
    algorithm.episodes_done = state["episodes_done"]


def memory_state(memory: LongTermMemory) -> dict[str, Any]:
    """The transitions stored so far with the leaves of the trees that they are sampled by.

    The trees themselves are objects of TorchRL; every other node of them is a sum or a minimum of its leaves.
    """
    count = len(memory)
    if not count:
        return {"count": 0}
    index = torch.arange(count)
    leaves = {name: torch.as_tensor(getattr(memory.sampler, name)[index]).reshape(count) for name in TREES}
    transitions = memory._buffer._storage.get(index).flatten_keys(".").to_dict()
    return {"count": count, "transitions": transitions, "max_priority": memory.sampler._max_priority} | leaves


def restored_memory(algorithm: ReinforcementTwinning, state: dict[str, Any]) -> LongTermMemory:
    """A new long-term memory that holds and samples what the saved one did."""
    memory = LongTermMemory(algorithm.config.long_term, generator=algorithm.generator)
    if not state["count"]:
        return memory
    index = torch.arange(state["count"])
    transitions = TensorDict(state["transitions"], batch_size=[state["count"]], device=algorithm.generator.device)
    memory._buffer._storage.set(index, transitions.unflatten_keys("."))
    for name in TREES:
        getattr(memory.sampler, name)[index] = state[name]
    memory.sampler._max_priority = state["max_priority"]
    return memory


def _process(entry: dict[str, Any], device: torch.device) -> ExogenousProcess:
    process = ExogenousProcess.__new__(ExogenousProcess)  # not fitted again
    for name in PROCESS:
        setattr(process, name, entry[name].to(device))
    return process


def save(path: Path, algorithm: ReinforcementTwinning, episodes: list[dict[str, Any]]) -> None:
    """Write a checkpoint; whatever happens while it is written leaves the one before intact.

    Raises:
        ValueError: if a part's state is more than tensors, numbers and strings, such as an environment's.
        OSError: if it cannot be written.
    """
    save_tensors(path, {"format": FORMAT, "episodes": episodes, "state": state_of(algorithm)})


def load(path: Path, algorithm: ReinforcementTwinning) -> list[dict[str, Any]]:
    """Restore a checkpoint and return the records of its episodes.

    Raises:
        ValueError: if there is none at ``path``, it is damaged, of another format or plant, or does not fit.
    """
    if not path.is_file():
        raise ValueError(f"there is no checkpoint {path} to go on from.")
    try:
        found = load_tensors(path)
        if found.get("format") != FORMAT:
            raise ValueError(f"{path} has checkpoint format {found.get('format')}; this version reads format {FORMAT}.")
        restore(algorithm, found["state"])
    except ValueError as error:
        raise ValueError(f"{error} To train anew in this folder, use --overwrite.") from error
    return found["episodes"]
