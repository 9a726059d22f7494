"""What a command can change within a decision: increments over the applied action where a rate is limited."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds


class Increments(nn.Module):
    r"""Actions in units of what the actuators can do within m control intervals.

    .. math::
        u = \frac{a - c(s)}{h}, \qquad
        (c, h) = (a_{last},\ m\,\dot a_{max}\Delta t) \text{ with a rate limit}, \quad
        \big(\tfrac12(a_{lo} + a_{hi}),\ \tfrac12(a_{hi} - a_{lo})\big) \text{ without}

    A plant says by its signals and by :meth:`Plant.actuate` where it limits a rate: a state with the name of an action
    is the action that was applied last, and the actuators reach only a part of the range from there. An action whose
    whole range is within reach is scaled by its range.

    Args:
        plant: plant whose actions are scaled.
        intervals: number m of control intervals of a decision.
        device: device of the scales; torch's default if None.

    Raises:
        ValueError: if an action has no finite range, or ``intervals`` is below 1.
    """

    low: Tensor
    high: Tensor
    middle: Tensor
    scale: Tensor
    limited: Tensor

    def __init__(self, plant: Plant, *, intervals: int = 1, device: torch.device | None = None):
        super().__init__()
        if intervals < 1:
            raise ValueError(f"intervals={intervals} of a decision must be at least 1.")
        low, high = bounds(plant.actions)
        unbounded = [
            action.name for action, span in zip(plant.actions, (high - low).tolist(), strict=True) if span == torch.inf
        ]
        if unbounded:
            raise ValueError(
                f"actions {', '.join(unbounded)} of plant {plant.name!r} have no finite range; give them low and high."
            )
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        names = [state.name for state in plant.states]
        self._places = [names.index(action.name) if action.name in names else 0 for action in plant.actions]
        reach = intervals * greatest_increments(plant).to(low.device)
        limited = reach < half
        parts = {"low": low, "high": high, "middle": middle, "scale": torch.minimum(reach, half), "limited": limited}
        for name, values in parts.items():
            self.register_buffer(name, values.to(device=device))

    def centre(self, state: Float[Tensor, "*batch n_s"]) -> Float[Tensor, "*batch n_a"]:
        """The action c(s) from which u counts."""
        return torch.where(self.limited, state[..., self._places], self.middle)

    def scaled(
        self, centre: Float[Tensor, "*batch n_a"], action: Float[Tensor, "*batch n_a"]
    ) -> Float[Tensor, "*batch n_a"]:
        """The u of an action; that of a command may lie beyond [−1, 1], where no actuator gets within a decision."""
        return (action - centre) / self.scale


@torch.no_grad()
def greatest_increments(plant: Plant) -> Float[Tensor, " n_a"]:
    """The greatest change of each applied action within a control interval; infinity where no rate is limited.

    Args:
        plant: plant whose :meth:`Plant.actuate` is asked, in a state in which each applied action is in the middle of
            its range.
    """
    device = next((x.device for x in plant.buffers()), torch.device("cpu"))
    low, high = bounds(plant.actions, device=device)
    names = [state.name for state in plant.states]
    state = plant.draw_initial_state(1, torch.Generator(device=device).manual_seed(0))
    remembered = [action.name in names for action in plant.actions]
    for action, known, middle in zip(plant.actions, remembered, 0.5 * (low + high), strict=True):
        if known:
            state[..., names.index(action.name)] = middle
    ends = (plant.actuate(state, end.expand(1, -1))[0] for end in (low, high))
    reach = torch.stack([(end - 0.5 * (low + high)).abs() for end in ends]).amax(0)
    free = reach >= 0.5 * (high - low) * (1.0 - 1e-9)
    return torch.where(free | ~torch.tensor(remembered, device=device), torch.inf, reach)
