"""What is wrong with a classical controller, before a training finds it."""

import torch
from torch import Tensor

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.plants.plant import Plant

BATCH = 3


def require_controller(name: str, law: object, plant: Plant) -> None:
    """Refuse what is no class of classical controllers, or one whose law does not fit the plant.

    Args:
        name: what the class was given as, for the message.
        law: the class.
        plant: the plant that it controls.

    Raises:
        ValueError: if there is something wrong; the message says what, and what is expected.
    """
    if not (isinstance(law, type) and issubclass(law, ClassicalController)):
        given = f"the class {law.__name__}" if isinstance(law, type) else f"an instance of {type(law).__name__}"
        instead = f"its class, {type(law).__name__}" if isinstance(law, ClassicalController) else "a subclass of it"
        raise ValueError(f"{name}, {given}, must be a class derived from ClassicalController; give {instead}.")
    controller, generator = law(plant), torch.Generator().manual_seed(0)
    state = plant.draw_initial_state(BATCH, generator)[:, : len(plant.readings)]
    size, about = controller.memory_size, f"{name}: {law.__name__}"
    memory = controller.first_memory(state)
    _require(f"{about}.first_memory returns", memory, size, f"memory_size={size}")
    try:
        found = controller.act(state, memory)
    except (IndexError, RuntimeError) as error:
        raise ValueError(
            f"{about}.act fails for states of shape {tuple(state.shape)} and a memory of shape {tuple(memory.shape)}: "
            f"{str(error).splitlines()[0]}. Its memory has as many columns as memory_size={size} says."
        ) from error
    if not (isinstance(found, tuple) and len(found) == 2):
        raise ValueError(f"{about}.act returns {type(found).__name__}; give both: return command, memory.")
    actions = ", ".join(signal.name for signal in plant.actions)
    _require(f"{about}.act returns a command,", found[0], len(plant.actions), f"actions {actions}")
    _require(f"{about}.act returns a memory,", found[1], size, f"memory_size={size}")


def _require(about: str, found: object, columns: int, why: str) -> None:
    """Refuse what is no finite tensor of a batch with so many columns in double precision."""
    given = f"{tuple(found.shape)} in {found.dtype}" if isinstance(found, Tensor) else type(found).__name__
    if not isinstance(found, Tensor) or tuple(found.shape) != (BATCH, columns) or found.dtype != torch.float64:
        raise ValueError(
            f"{about} {given} for {BATCH} states; expected shape {(BATCH, columns)} in torch.float64 ({why}). A column "
            "is state[:, :1], not state[:, 0]."
        )
    if not found.isfinite().all():
        raise ValueError(f"{about} numbers that are not finite for states that the plant draws.")
