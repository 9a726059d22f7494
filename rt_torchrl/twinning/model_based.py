"""Step 5: the model-based policy is planned on the twin."""

import copy
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.optimisers.descent import Descended, Descent, DescentConfig
from rt_torchrl.options import check_options
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.short_horizon import ShortHorizon, ShortHorizonConfig


@dataclass(frozen=True, kw_only=True)
class ModelBasedConfig:
    """Parameters of step 5.

    Args:
        iterations: n_mb, gradients per episode; sweeps through whole virtual episodes with a short horizon.
        realisations: N_z of this step; None for that of the others. One virtual episode costs about as much as twenty,
            and where the initial states differ much, a plan made on one of them says little of the others.
        experience: number of latest real episodes whose exogenous inputs steps 5 and 6 draw from; 1 as in the paper.
        descent: how the policy's weights descend J_a.
        short_horizon: planning over short windows, where the gradients of whole episodes say nothing.
    """

    iterations: int = 10
    realisations: int | None = None
    experience: int = 100
    descent: DescentConfig = field(default_factory=DescentConfig)
    short_horizon: ShortHorizonConfig = field(default_factory=ShortHorizonConfig)

    def __post_init__(self):
        check_options(self)
        if self.iterations < 0:
            raise ValueError(f"iterations={self.iterations} of the planning (n_mb) must not be negative.")
        if self.realisations is not None and self.realisations < 1:
            raise ValueError(f"realisations={self.realisations} of the planning (N_z) must be at least 1.")
        if self.experience < 1:
            raise ValueError(f"experience={self.experience} of the planning must be at least 1 episode.")


class VirtualEpisodes(NamedTuple):
    """Initial states and exogenous inputs to fly on the twin."""

    initial_state: Float[Tensor, "batch n_s"]
    exogenous: Float[Tensor, "batch n n_z"]


class Plan(NamedTuple):
    """What the gradient steps found, and whether it was kept."""

    descended: Descended
    accepted: bool


class ModelBased:
    r"""Minimises :math:`J_a = \mathbb E\frac1{T_o}\int L_a\,dt` over the weights of π_mb, on the twin (paper, eq. J_a).

    Args:
        twin: with the best closure so far, w_p*.
        policy: π_mb, updated in place.
        config: see :class:`ModelBasedConfig`.
        generator: source of what a short horizon needs to be initialised; nothing is drawn without one.
    """

    def __init__(self, twin: DigitalTwin, policy: nn.Module, config: ModelBasedConfig, *, generator: torch.Generator):
        self.twin, self.policy, self.config = twin, policy, config
        self.descent: Descent | ShortHorizon
        if config.short_horizon.window:
            self.descent = ShortHorizon(twin, policy, config.short_horizon, generator=generator)
        else:
            self.descent = Descent(policy, config.descent)

    def restart(self) -> None:
        """Forget the state of the optimiser, because the policy's weights have jumped."""
        self.descent.restart()

    def update(self, planned_on: VirtualEpisodes, judged_on: VirtualEpisodes) -> Plan:
        """One episode's gradient steps; the new plan is kept only if it is better on episodes it was not made on.

        Note: the paper keeps every plan; here a plan made on N_z winds is compared with the one before on N others,
        because the best policy for a few winds can lie just beyond a cliff of another one.
        """
        before = copy.deepcopy(self.policy.state_dict())
        with torch.no_grad():
            incumbent = self._cost(judged_on)
        descended = self._descend(planned_on)
        with torch.no_grad():
            accepted = bool(self._cost(judged_on) <= incumbent)
        if not accepted:
            self.policy.load_state_dict(before)
            if isinstance(self.descent, Descent):
                self.restart()
        return Plan(descended, accepted)

    def _descend(self, planned_on: VirtualEpisodes) -> Descended:
        if isinstance(self.descent, Descent):
            return self.descent.run(lambda: self._cost(planned_on), self.config.iterations)
        with torch.no_grad():
            start = self._cost(planned_on).item()
        gradients = [self.descent.sweep(*planned_on) for _ in range(self.config.iterations)]
        self.policy.load_state_dict(self.descent.learner.state_dict())
        with torch.no_grad():
            end = self._cost(planned_on).item()
        return Descended(start, end, gradients[0] if gradients else float("nan"), len(gradients))

    def _cost(self, episodes: VirtualEpisodes) -> Tensor:
        return self.twin.cost(self.policy, *episodes)
