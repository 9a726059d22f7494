"""Step 5: the model-based policy is planned on the twin."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from rt_torchrl.descent import Descended, Descent, DescentConfig
from rt_torchrl.exogenous import ExogenousProcess
from rt_torchrl.trajectory import control_cost
from rt_torchrl.twin import DigitalTwin


@dataclass(frozen=True, kw_only=True)
class ModelBasedConfig:
    """Parameters of step 5.

    Args:
        iterations: n_mb, gradients per episode.
        descent: how the policy's weights descend J_a.
    """

    iterations: int = 10
    descent: DescentConfig = field(default_factory=DescentConfig)

    def __post_init__(self):
        if self.iterations < 0:
            raise ValueError(f"iterations={self.iterations} of the planning (n_mb) must not be negative.")


class ModelBased:
    r"""Minimises :math:`J_a = \mathbb E\frac1{T_o}\int L_a\,dt` over the weights of π_mb, on the twin (paper, eq. J_a).

    Args:
        twin: with the best closure so far, w_p*.
        policy: π_mb, updated in place.
        config: see :class:`ModelBasedConfig`.
    """

    def __init__(self, twin: DigitalTwin, policy: nn.Module, config: ModelBasedConfig):
        self.twin, self.policy, self.config = twin, policy, config
        self.descent = Descent(policy, config.descent)

    def restart(self) -> None:
        """Forget the state of the optimiser, because the policy's weights have jumped."""
        self.descent.restart()

    def update(self, processes: Sequence[ExogenousProcess], count: int, generator: torch.Generator) -> Descended:
        """One episode's gradient steps.

        Note: the paper starts all virtual trajectories in the initial state of the record; here they start in random
        ones, because a policy planned from one start alone steps over cliffs that it does not see (a turbine that
        stalls when it starts slower), and because step 6 judges it from random ones.

        Args:
            processes: the exogenous process of each record in D_S.
            count: N_z, realisations of each.
            generator: source of the realisations and the initial states.
        """
        exogenous = torch.cat([process.sample(count, generator) for process in processes])
        initial_state = self.twin.plant.draw_initial_state(len(exogenous), generator)

        def cost() -> Tensor:
            flown = self.twin.control(self.policy, initial_state, exogenous)
            return control_cost(self.twin.plant, flown, exogenous).mean()

        return self.descent.run(cost, self.config.iterations)

