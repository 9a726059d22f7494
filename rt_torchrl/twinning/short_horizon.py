r"""Planning over short windows with a learned tail cost, for tasks whose long gradients say nothing.

Where small changes of a policy decide whether an episode succeeds, the gradient of a whole episode's cost explodes with
its length, and its descent stops at the next of many local minima: a pendulum then never learns to swing up. Here an
episode is cut into windows of n intervals, and what comes after a window is estimated by a critic v of the observation,

.. math::
    J_w = (1 - \gamma)\sum_{k<n}\gamma^kL_k + \gamma^n\,v(e_n), \qquad
    v(e_k) \approx (1 - \gamma)\sum_{j\ge0}\gamma^jL_{k+j}

whose targets are mixed over the window's lengths by λ. The policy takes one step for each window, on the exact
gradient of J_w through the twin; the critic's smoothness hides the cliffs beyond. It is no guarantee: of seven
trainings on the pendulum one stayed in a minimum where the rod is held upright but not swung up.

Source: Xu et al., *Accelerated policy learning with parallel differentiable simulation*, ICLR 2022 (SHAC).
"""

import copy
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.interruption import safe_point
from rt_torchrl.plants.policies import mlp
from rt_torchrl.trajectories.trajectory import control_cost
from rt_torchrl.trajectories.twin import DigitalTwin


@dataclass(frozen=True, kw_only=True)
class ShortHorizonConfig:
    """Parameters of the planning over short windows.

    Args:
        window: control intervals of a window; 0 plans over whole episodes instead, as in the paper.
        discount: γ per control interval.
        mixing: λ, how much the critic's targets trust the rest of the window over the critic itself.
        critic_iterations: gradients of the critic for each window.
        critic_hidden: widths of the critic's hidden layers.
        target_rate: share by which the target critic moves towards the critic after each window.
        policy_rate: learning rate of the policy (Adam).
        critic_rate: learning rate of the critic (Adam).
    """

    window: int = 0
    discount: float = 0.98
    mixing: float = 0.95
    critic_iterations: int = 8
    critic_hidden: tuple[int, ...] = (64, 64)
    target_rate: float = 0.2
    policy_rate: float = 5e-3
    critic_rate: float = 2e-3

    def __post_init__(self):
        for argument, least in (("window", 0), ("critic_iterations", 1)):
            if getattr(self, argument) < least:
                raise ValueError(f"{argument}={getattr(self, argument)} of the short horizon must be at least {least}.")
        if not 0.0 <= self.discount < 1.0:
            raise ValueError(f"discount={self.discount} of the short horizon must lie in [0, 1).")
        for argument in ("mixing", "target_rate"):
            if not 0.0 < getattr(self, argument) <= 1.0:
                raise ValueError(f"{argument}={getattr(self, argument)} of the short horizon must lie in (0, 1].")
        for argument in ("policy_rate", "critic_rate"):
            if not getattr(self, argument) > 0.0:
                raise ValueError(f"{argument}={getattr(self, argument)} of the short horizon must be positive.")


MODULES = ("learner", "critic", "target")


class ShortHorizon:
    """Descends J_w of one window after the other, along virtual episodes.

    What descends is a copy of the policy, because it gets worse before it gets better while the critic is still wrong:
    it goes on from episode to episode, whether or not it is good enough yet to take the policy's place.

    Args:
        twin: flies the windows.
        policy: π_mb, not changed here; ``learner`` is the copy.
        config: see :class:`ShortHorizonConfig`.
        generator: source of the critic's initial weights.

    Raises:
        ValueError: if a window is longer than an episode.
    """

    gradient_limit = 1.0
    moments = (0.7, 0.95)  # of Adam: the cost is another one in every window

    def __init__(self, twin: DigitalTwin, policy: nn.Module, config: ShortHorizonConfig, *, generator: torch.Generator):
        if config.window > twin.plant.n_steps:
            raise ValueError(
                f"window={config.window} exceeds the {twin.plant.n_steps} control intervals of an episode of plant "
                f"{twin.plant.name!r}; 0 plans over whole episodes."
            )
        self.twin, self.policy, self.config = twin, policy, config
        n_o = len(twin.plant.observations)
        critic = mlp(n_o, config.critic_hidden, 1, generator=generator, activation=nn.SiLU)
        self.critic = critic.to(generator.device)
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self._critic_optimiser = torch.optim.Adam(self.critic.parameters(), lr=config.critic_rate, betas=self.moments)
        self.reference = 0.0
        self.restart()

    def restart(self) -> None:
        """Go on from the policy as it is now, because its weights have jumped."""
        self.learner = copy.deepcopy(self.policy)
        self._optimiser = torch.optim.Adam(self.learner.parameters(), lr=self.config.policy_rate, betas=self.moments)

    def sweep(self, initial_state: Float[Tensor, "batch n_s"], exogenous: Float[Tensor, "batch n n_z"]) -> float:
        """Fly the episodes once, then take a step of the policy for each of their whole windows.

        Every step is on windows of all phases of the episode, one of each realisation: with those of one phase alone
        the critic forgets the others.

        Returns:
            Mean norm of the gradients of J_w, relative to the mean cost of the first sweep.
        """
        plant, n = self.twin.plant, self.config.window
        batch, count = len(exogenous), exogenous.shape[1] // n
        with torch.no_grad():
            flown = self.twin.control(self.learner, initial_state, exogenous)
        self.reference = self.reference or control_cost(plant, flown, exogenous).mean().item() or 1.0
        inputs = exogenous[:, : count * n].unflatten(1, (count, n))
        rows, norms = torch.arange(batch, device=exogenous.device), []
        for shift in range(count):
            safe_point()
            phase = (rows + shift) % count
            start = plant.dt * n * phase.double()
            norms.append(self._window(flown.states[rows, phase * n], inputs[rows, phase], start))
        return sum(norms) / len(norms)

    def _window(
        self,
        state: Float[Tensor, "batch n_s"],
        inputs: Float[Tensor, "batch n n_z"],
        start: Float[Tensor, " batch"],
    ) -> float:
        """One step of the policy, then the critic's; the norm of the policy's gradient."""
        plant = self.twin.plant
        flown = self.twin.control(self.learner, state, inputs, start=start)
        clock = plant.dt * torch.arange(inputs.shape[1] + 1, dtype=torch.float64, device=inputs.device)
        t = start.unsqueeze(-1) + clock
        costs = plant.running_cost(t[:, :-1], flown.states[:, :-1], flown.actions, inputs) / self.reference
        # There is no input after the last interval.
        seen = plant.observe(t, flown.states, torch.cat([inputs, inputs[:, -1:]], 1))
        norm = self._improve_policy(costs, seen)
        self._improve_critic(costs.detach(), seen.detach())
        return norm

    def _improve_policy(self, costs: Float[Tensor, "batch n"], seen: Float[Tensor, "batch m n_o"]) -> float:
        gamma, n = self.config.discount, costs.shape[1]
        weights = (1.0 - gamma) * gamma ** torch.arange(n, dtype=costs.dtype, device=costs.device)
        J_w = (costs * weights).sum(-1) + gamma**n * self.target(seen[:, -1]).squeeze(-1)
        self._optimiser.zero_grad(set_to_none=True)
        J_w.mean().backward()
        norm = nn.utils.clip_grad_norm_(self.learner.parameters(), self.gradient_limit)
        self._optimiser.step()
        return norm.item()

    def _improve_critic(self, costs: Float[Tensor, "batch n"], seen: Float[Tensor, "batch m n_o"]) -> None:
        targets = self._targets(costs, seen)
        for _ in range(self.config.critic_iterations):
            loss = (self.critic(seen[:, :-1]).squeeze(-1) - targets).square().mean()
            self._critic_optimiser.zero_grad(set_to_none=True)
            loss.backward()
            self._critic_optimiser.step()
        with torch.no_grad():
            for slow, fast in zip(self.target.parameters(), self.critic.parameters(), strict=True):
                slow.lerp_(fast, self.config.target_rate)

    @torch.no_grad()
    def _targets(self, costs: Float[Tensor, "batch n"], seen: Float[Tensor, "batch m n_o"]) -> Float[Tensor, "batch n"]:
        """(1 − γ)L_k + γ((1 − λ)v(e_{k+1}) + λ·target_{k+1}), from the last interval back."""
        gamma, mixing = self.config.discount, self.config.mixing
        values = self.target(seen).squeeze(-1)
        following, found = values[:, -1], []
        for cost, value in zip(costs.flip(1).unbind(1), values[:, 1:].flip(1).unbind(1), strict=True):
            following = (1.0 - gamma) * cost + gamma * ((1.0 - mixing) * value + mixing * following)
            found.append(following)
        return torch.stack(found, 1).flip(1)

    def state_dict(self) -> dict[str, Any]:
        modules = {name: getattr(self, name).state_dict() for name in MODULES}
        optimisers = {"policy": self._optimiser.state_dict(), "values": self._critic_optimiser.state_dict()}
        return modules | optimisers | {"reference": self.reference}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name in MODULES:
            getattr(self, name).load_state_dict(state[name])
        self._optimiser.load_state_dict(state["policy"])
        self._critic_optimiser.load_state_dict(state["values"])
        self.reference = state["reference"]
