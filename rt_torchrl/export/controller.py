r"""The controller of a plant: its policy with the states that it computes of the measured signals.

The states of a plant are :math:`s = (y, c)`, with c those of :attr:`Plant.controller_states` and y the measured ones.
At :math:`t_k` the controller takes c over the interval that has passed, and acts:

.. math::
    c_k = \Phi_c(t_{k-1}, (y_{k-1}, c_{k-1}), a_{k-1}, z_{k-1}), \qquad
    a_k = \pi\big(\mathrm{observe}(t_k, (y_k, c_k), z_k)\big)

:math:`\Phi_c` is the plant's own step, in which y moves in a straight line from :math:`y_{k-1}` to :math:`y_k` instead
of by the vector field. Filters and integrals then differ from the plant's own by the curvature of y within an interval,
:math:`O(\Delta t^2)`, and need no closure.
"""

import copy

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.export.agreement import frozen
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import differences, place_of


class Controller:
    """The controller of a plant under a policy, for any number of machines at once.

    Args:
        plant: the plant; its closure is called, but no result may depend on it.
        policy: the policy.

    Raises:
        ValueError: if the plant has no state of a name in its ``controller_states``.
    """

    def __init__(self, plant: Plant, policy: nn.Module):
        self.plant, self.policy = frozen(plant), policy
        self.closure: nn.Module = self.plant.closure
        names = plant.controller_states
        self.held = [place_of("controller_states", name, plant.states, plant.name) for name in names]
        self.measured = [k for k in range(len(plant.states)) if k not in self.held]
        self._order = torch.tensor([*self.measured, *self.held]).argsort()
        self._moving = copy.deepcopy(self.plant)

    def start(self, measured: Float[Tensor, "*batch n_y"], inputs: Float[Tensor, "*batch n_z"]) -> Tensor:
        """The controller's states c_0 at the first measurement.

        Raises:
            ValueError: if the plant starts another number of states than it names.
        """
        start = self.plant.controller_start(measured, inputs)
        if start.shape[-1:] != (len(self.held),):
            raise ValueError(
                f"controller_start of plant {self.plant.name!r} returns shape {tuple(start.shape)}; its last dimension "
                f"must be {len(self.held)}, the number of controller_states."
            )
        return start

    def act(
        self,
        t: Float[Tensor, "*#batch"],
        memory: Float[Tensor, "*batch n_c"],
        measured: Float[Tensor, "*batch n_y"],
        inputs: Float[Tensor, "*batch n_z"],
    ) -> tuple[Float[Tensor, "*batch n_a"], Float[Tensor, "*batch n_a"]]:
        """The command a_k of the policy, and the action that the actuators make of it.

        Args:
            t: present time [s].
            memory: the controller's states c_k.
            measured: measured states y_k.
            inputs: exogenous inputs z_k.
        """
        state = self.joined(measured, memory)
        command = self.policy(self.plant.observe(t, state, inputs))
        return command, self.plant.actuate(state, command)

    def advance(
        self,
        t: Float[Tensor, "*#batch"],
        memory: Float[Tensor, "*batch n_c"],
        measured: Float[Tensor, "*batch n_y"],
        inputs: Float[Tensor, "*batch n_z"],
        command: Float[Tensor, "*batch n_a"],
        following: Float[Tensor, "*batch n_y"],
    ) -> Float[Tensor, "*batch n_c"]:
        """The controller's states at the end of an interval.

        Args:
            t: time at its start [s].
            memory: the controller's states at its start.
            measured: measured states at its start.
            inputs: exogenous inputs that acted during it.
            command: command that was held during it.
            following: measured states at its end.
        """
        signals = [self.plant.states[k] for k in self.measured]
        rate = differences(signals, following, measured) / self.plant.dt if signals else measured
        state = self.joined(measured, memory)
        return self._along(rate).step(t, state, command, inputs, self.closure).state[..., self.held]

    def _along(self, rate: Tensor) -> Plant:
        """The plant whose measured states change at a given rate."""
        inner, field = self._moving.innermost, self.plant.innermost.vector_field
        # Extensions call the vector field of the plant that they extend, whose states are the first ones.
        n = len(inner.states)
        measured, held = ([k for k in places if k < n] for places in (self.measured, self.held))
        order = torch.tensor([*measured, *held]).argsort()

        def vector_field(t: Tensor, state: Tensor, action: Tensor, exogenous: Tensor, closure: nn.Module) -> Tensor:
            held_rates = field(t, state, action, exogenous, closure)[..., held]
            return torch.cat([rate[..., : len(measured)], held_rates], -1)[..., order]

        vars(inner)["vector_field"] = vector_field
        return self._moving

    def joined(self, measured: Tensor, memory: Tensor) -> Tensor:
        """States of measured ones and the controller's, in the plant's order."""
        return torch.cat([measured, memory], -1)[..., self._order]
