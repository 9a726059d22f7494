"""Classical controllers: laws of the measured state that may have a memory, to compare learned policies with."""

from abc import ABC, abstractmethod

import torch
from hoptorch.scan import scan
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.compilation import compiled_if
from rt_torchrl.plant import Plant
from rt_torchrl.trajectory import Trajectory


class ClassicalController(nn.Module, ABC):
    r"""A law :math:`(a_k, m_{k+1}) = c(s_k, m_k)` with memory m, which no ``policy(observation)`` can be.

    Its gains are held by their logarithms, so that a search changes each in proportion and never its sign.

    Args:
        plant: what it controls; its actuators limit range and rate.
        gains: in the order and the units of ``gain_units``; None for the defaults.
        compiled: compile the flight.

    Raises:
        ValueError: if the number of gains is wrong or one of them is not positive and finite.
    """

    gain_units: dict[str, str] = {}
    """Unit of each gain, by name."""
    default_gains: tuple[float, ...] = ()
    placed_gains: tuple[float, ...] | None = None
    """Gains by a rule of thumb, where a search is to start from them and not from the defaults."""
    memory_size: int = 0

    def __init__(self, plant: Plant, gains: tuple[float, ...] | None = None, *, compiled: bool = False):
        super().__init__()
        values = torch.tensor(self.default_gains if gains is None else gains, dtype=torch.float64)
        if len(values) != len(self.gain_units) or not (values.isfinite() & (values > 0)).all():
            wanted = ", ".join(f"{name} [{unit}]" for name, unit in self.gain_units.items())
            raise ValueError(f"gains={gains} of {type(self).__name__} must be positive and finite: {wanted}.")
        self.plant = plant
        self.log_gains = nn.Parameter(values.log(), requires_grad=False)
        for bound in ("low", "high"):
            limits = torch.tensor([getattr(a, bound) for a in plant.actions], dtype=torch.float64)
            self.register_buffer(f"{bound}_action", limits)
        self._flight = compiled_if(compiled, flight_by_scan, flight)

    def named_gains(self) -> dict[str, float]:
        """The gains by name."""
        return dict(zip(self.gain_units, self.log_gains.exp().tolist(), strict=True))

    def first_memory(self, state: Float[Tensor, "batch n_s"]) -> Float[Tensor, "batch n_m"]:
        """Memory at the start of an episode; zeros unless overridden."""
        return state.new_zeros(len(state), self.memory_size)

    @abstractmethod
    def act(
        self, state: Float[Tensor, "batch n_s"], memory: Float[Tensor, "batch n_m"]
    ) -> tuple[Float[Tensor, "batch n_a"], Float[Tensor, "batch n_m"]]:
        """Command, held to the ranges of the actions by the caller, and the new memory."""

    @torch.no_grad()
    def fly(self, initial_state: Float[Tensor, "batch n_s"], exogenous: Float[Tensor, "batch n n_z"]) -> Trajectory:
        """Real episodes under this controller."""
        n_s = len(self.plant.states)
        start = torch.cat([initial_state, self.first_memory(initial_state)], -1)
        t = self.plant.dt * torch.arange(exogenous.shape[1], dtype=torch.float64, device=exogenous.device)
        flown = self._flight(self, start, t.unsqueeze(-1), exogenous.transpose(0, 1).contiguous()).transpose(0, 1)
        states = torch.cat([initial_state.unsqueeze(1), flown[..., :n_s]], 1)
        return Trajectory(states, flown[..., start.shape[1] :])


def interval(controller: ClassicalController, carry: Tensor, t: Tensor, exogenous: Tensor) -> tuple[Tensor, Tensor]:
    """(state, memory) after an interval, and the action applied in it."""
    plant, n_s = controller.plant, len(controller.plant.states)
    state, memory = carry[..., :n_s], carry[..., n_s:]
    command, memory = controller.act(state, memory)
    command = command.clamp(controller.low_action, controller.high_action)
    end, applied = plant.step(t, state, command, exogenous, plant.closure)
    return torch.cat([end, memory], -1), applied


def flight(controller: ClassicalController, start: Tensor, t: Tensor, exogenous: Tensor) -> Tensor:
    """(state, memory, action) of every interval, time first, by a loop."""
    carry, found = start, []
    for now, z in zip(t, exogenous, strict=True):
        carry, applied = interval(controller, carry, now, z)
        found.append(torch.cat([carry, applied], -1))
    return torch.stack(found)


def flight_by_scan(controller: ClassicalController, start: Tensor, t: Tensor, exogenous: Tensor) -> Tensor:
    """The same by one ``scan``, for the compiler."""

    def body(carry, x):
        carry, applied = interval(controller, carry, *x)
        return carry.contiguous(), torch.cat([carry, applied], -1)

    return scan(body, start.clone(memory_format=torch.contiguous_format), (t, exogenous))[1]
