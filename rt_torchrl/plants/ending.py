r"""The early end of an episode, such as by overspeed or ground contact.

A system that has ended stays in the state in which it ended, and each moment after the end t_e costs L_e:

.. math:: J_a = \frac1{T_o}\Big(\int_0^{t_e} L_a\,dt + (T_o - t_e) L_e\Big)

There is no terminal cost Φ_a then. With an absorbing state the cost of an episode is one number, however long the
episode lasts, and the value of what comes after the end is known: a learner with the discount γ per interval counts
:math:`-L_e/(1 - \gamma)`.
"""

from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rt_torchrl.plants.innermost import innermost

if TYPE_CHECKING:
    from rt_torchrl.plants.plant import Plant


class Ending:
    """States in which episodes of a plant end early, and what an end costs; by default no episode ends early."""

    end_cost: float | None = None
    """Cost L_e of each moment after an early end [unit of L_a]; None in a plant whose episodes never end early."""

    def ended(self, state: Float[Tensor, "*batch n_s"]) -> Bool[Tensor, "*batch"]:
        """Whether an episode has ended in this state; by default never.

        A plant that overrides this method sets :attr:`end_cost`, greater than what L_a is in a bad episode, or else an
        early end would pay.
        """
        return torch.zeros_like(state[..., 0], dtype=torch.bool)


def require_end_cost(plant: "Plant") -> None:
    """Refuse a plant whose episodes end early at no cost, or at one that is no number.

    Raises:
        ValueError: if there is no finite ``end_cost``.
    """
    # An extension ends where its plant does.
    if type(innermost(plant)).ended is not Ending.ended and plant.end_cost is None:
        raise ValueError(
            f"plant {plant.name!r} defines ended() and no end_cost; set it to the cost of each moment after an early "
            "end, greater than the running cost of a bad episode."
        )
    if plant.end_cost is not None and not torch.tensor(plant.end_cost).isfinite():
        raise ValueError(f"end_cost={plant.end_cost} of plant {plant.name!r} must be finite.")


def held(plant: "Plant", state: Float[Tensor, "*batch n_s"], end: Float[Tensor, "*batch n_s"]) -> Tensor:
    """The state at the end of an interval that began in ``state``: the same one if the episode had ended in it."""
    return end if plant.end_cost is None else torch.where(plant.ended(state).unsqueeze(-1), state, end)


def cost_rate(plant: "Plant", t: Tensor, state: Tensor, applied: Tensor, exogenous: Tensor) -> Float[Tensor, "*batch"]:
    """L_a in an interval that began in ``state``, or L_e if the episode had ended in it."""
    running = plant.running_cost(t, state, applied, exogenous)
    if plant.end_cost is None:
        return running
    return torch.where(plant.ended(state), torch.full_like(running, plant.end_cost), running)


def final_cost(plant: "Plant", state: Float[Tensor, "*batch n_s"]) -> Float[Tensor, "*batch"]:
    """Φ_a of the last state of an episode, or zero if the episode had ended in it."""
    terminal = plant.terminal_cost(state)
    return terminal if plant.end_cost is None else torch.where(plant.ended(state), torch.zeros_like(terminal), terminal)


def flight_costs(
    plant: "Plant",
    t: Tensor,
    states: Float[Tensor, "*batch m n_s"],
    applied: Float[Tensor, "*batch n n_a"],
    exogenous: Float[Tensor, "*batch n n_z"],
) -> tuple[Float[Tensor, "*batch n"], Bool[Tensor, "*batch"]]:
    """L_a in each interval of a flight, or L_e from its early end on, and whether it has ended by its last state.

    A flight under recorded actions may leave the state again in which it ended, unlike one of :func:`held`.
    """
    running = plant.running_cost(t, states[..., :-1, :], applied, exogenous)
    if plant.end_cost is None:
        return running, torch.zeros_like(states[..., 0, 0], dtype=torch.bool)
    over = plant.ended(states).cumsum(-1) > 0
    return torch.where(over[..., :-1], torch.full_like(running, plant.end_cost), running), over[..., -1]
