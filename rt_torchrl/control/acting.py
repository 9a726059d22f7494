"""A classical controller that acts on a real system, as it did before any policy was trained."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.trajectory import Trajectory


class ActingController(nn.Module):
    """A classical controller as :class:`StateFeedback`: it acts interval by interval and keeps its own memory.

    Args:
        controller: the controller.
    """

    def __init__(self, controller: ClassicalController):
        super().__init__()
        self.controller = controller
        self._memory: Tensor | None = None

    def begin(self) -> None:
        """Begin an episode with the first memory."""
        self._memory = None

    @torch.no_grad()
    def act(
        self, t: float, state: Float[Tensor, "batch n_s"], exogenous: Float[Tensor, "batch n_z"]
    ) -> Float[Tensor, "batch n_a"]:
        """The command in the measured state, within the ranges of the actions; time and inputs are not used."""
        memory = self.first_memory(state) if self._memory is None else self._memory
        command, self._memory = self.respond(state, memory)
        return command

    def first_memory(self, state: Float[Tensor, "batch n_s"]) -> Float[Tensor, "batch n_m"]:
        """The controller's memory at the start of an episode."""
        return self.controller.first_memory(state)

    def respond(
        self, state: Float[Tensor, "batch n_s"], memory: Float[Tensor, "batch n_m"]
    ) -> tuple[Float[Tensor, "batch n_a"], Float[Tensor, "batch n_m"]]:
        """The command, within the ranges of the actions, and the new memory."""
        return self.controller.respond(state, memory)

    def fly(
        self,
        initial_state: Float[Tensor, "batch n_s"],
        exogenous: Float[Tensor, "batch n n_z"],
        closure: nn.Module | None = None,
        *,
        plant: Plant | None = None,
    ) -> Trajectory:
        """Episodes of a simulated system; see :meth:`ClassicalController.fly`."""
        return self.controller.fly(initial_state, exogenous, closure, plant=plant)

    def report(self) -> dict[str, float]:
        """Nothing."""
        return {}
