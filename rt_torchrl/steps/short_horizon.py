r"""Planning over short windows with a learned tail cost, for tasks where gradients of whole episodes are of no use.

Where small changes of a policy decide whether an episode succeeds, the gradient of a whole episode's cost explodes with
the episode's length, and a descent stops at the next of many local minima: a pendulum then never learns to swing up.
Here an episode is cut into windows of n intervals, and a critic v of the observation estimates the cost after a window,

.. math::
    J_w = (1 - \gamma)\sum_{k<n}\gamma^kL_k + \gamma^n\,v(e_n), \qquad
    v(e_k) \approx (1 - \gamma)\sum_{j\ge0}\gamma^jL_{k+j}

The factor λ mixes the critic's targets over the rest of the window. The policy takes one step for each window, along
the exact gradient of J_w through the twin; the smooth critic hides the cliffs beyond the window. This is no guarantee:
one of seven trainings on the pendulum stayed in a minimum where the policy holds the rod upright but does not swing it
up.

Source: Xu et al., *Accelerated policy learning with parallel differentiable simulation*, ICLR 2022 (SHAC).
"""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from rt_torchrl.interruption import safe_point
from rt_torchrl.optimisers.descent import Descended
from rt_torchrl.plants.plant import cost_rate
from rt_torchrl.plants.policies import mlp
from rt_torchrl.steps.config import PlannerConfig
from rt_torchrl.trajectories.trajectory import Scenario, control_cost
from rt_torchrl.trajectories.twin import DigitalTwin

MODULES = ("learner", "critic", "target")


class ShortHorizon:
    """Descends J_w of one window after the other, along virtual episodes.

    A copy of the policy descends, because a policy gets worse before it gets better while the critic is still wrong.
    The copy goes on from episode to episode, whether or not it is good enough yet to take the policy's place. It plans
    for a process that goes on, without the plant's terminal cost. Where an episode ends early, v is known to be L_e
    from there on, and windows are taken from what comes before. The gradient of a window does not see its own end, but
    the critic at the end of earlier windows does.

    Args:
        twin: twin on which the windows are flown.
        policy: policy π_mb; a plan gives it the weights of the copy, ``learner``.
        config: parameters of step 5; ``iterations`` is the number of sweeps through the episodes.
        generator: source of the critic's initial weights.

    Raises:
        ValueError: if a window is longer than an episode.
    """

    discount, policy_rate, gradient_limit = 0.98, 5e-3, 1.0
    moments = (0.7, 0.95)  # Adam's decay rates, which are short because the cost changes with every window
    mixing = 0.95
    """Weight λ of the rest of the window in the critic's targets; the critic itself has the weight 1 − λ."""
    critic_hidden: Sequence[int] = (64, 64)
    critic_iterations, critic_rate, target_rate = 8, 2e-3, 0.2
    """Gradients of the critic for each window, their rate, and the share of the distance that the target then moves."""

    def __init__(self, twin: DigitalTwin, policy: nn.Module, config: PlannerConfig, *, generator: torch.Generator):
        if config.window > twin.plant.n_steps:
            raise ValueError(
                f"window={config.window} exceeds the {twin.plant.n_steps} control intervals of an episode of plant "
                f"{twin.plant.name!r}; multi_start plans over whole episodes."
            )
        self.twin, self.policy, self.iterations, self.window = twin, policy, config.iterations, config.window
        n_o = len(twin.plant.observations)
        critic = mlp(n_o, self.critic_hidden, 1, generator=generator, activation=nn.SiLU)
        self.critic = critic.to(generator.device)
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self._critic_optimiser = torch.optim.Adam(self.critic.parameters(), lr=self.critic_rate, betas=self.moments)
        self.reference = 0.0
        self.restart()

    def restart(self) -> None:
        """Copy the policy anew, because its weights have jumped."""
        self.learner = copy.deepcopy(self.policy)
        self._optimiser = torch.optim.Adam(self.learner.parameters(), lr=self.policy_rate, betas=self.moments)

    def plan(self, episodes: Scenario) -> Descended:
        """Give the policy the weights of the copy after its descent; see :meth:`Planner.plan`."""
        with torch.no_grad():
            start = self.twin.cost(self.policy, *episodes).item()
        gradients = [self.sweep(*episodes) for _ in range(self.iterations)]
        self.policy.load_state_dict(self.learner.state_dict())
        with torch.no_grad():
            end = self.twin.cost(self.policy, *episodes).item()
        return Descended(start, end, gradients[0] if gradients else float("nan"), len(gradients))

    def refuse(self) -> None:
        """Do nothing: the copy goes on from its present weights, because it gets worse before it gets better."""

    def sweep(self, initial_state: Float[Tensor, "batch n_s"], exogenous: Float[Tensor, "batch n n_z"]) -> float:
        """Fly the episodes once, then take a step of the policy for each of their whole windows.

        Every step takes one window from each realisation, and the windows are spread over all phases of the episode.
        With windows of one phase alone the critic would forget the other phases.

        Returns:
            Mean norm of the gradients of J_w, relative to the mean cost of the first sweep.
        """
        plant, n = self.twin.plant, self.window
        batch, count = len(exogenous), exogenous.shape[1] // n
        with torch.no_grad():
            flown = self.twin.control(self.learner, initial_state, exogenous)
        self.reference = self.reference or abs(control_cost(plant, flown).mean().item()) or 1.0
        inputs = exogenous[:, : count * n].unflatten(1, (count, n))
        rows, norms = torch.arange(batch, device=exogenous.device), []
        begun = (~plant.ended(flown.states[:, : count * n : n])).sum(1)  # windows before an early end
        for shift in range(count):
            safe_point()
            phase = (rows + shift) % begun
            start = plant.dt * n * phase.double()
            norms.append(self._window(flown.states[rows, phase * n], inputs[rows, phase], start))
        return sum(norms) / len(norms)

    def _window(
        self,
        state: Float[Tensor, "batch n_s"],
        inputs: Float[Tensor, "batch n n_z"],
        start: Float[Tensor, " batch"],
    ) -> float:
        """Take one step of the policy, then the critic's steps; return the norm of the policy's gradient."""
        plant = self.twin.plant
        flown = self.twin.control(self.learner, state, inputs, start=start)
        clock = plant.dt * torch.arange(inputs.shape[1] + 1, dtype=torch.float64, device=inputs.device)
        t = start.unsqueeze(-1) + clock
        costs = cost_rate(plant, t[:, :-1], flown.states[:, :-1], flown.actions, inputs) / self.reference
        # There is no input after the last interval; the last input takes its place.
        seen = plant.observe(t, flown.states, torch.cat([inputs, inputs[:, -1:]], 1))
        over = plant.ended(flown.states)
        norm = self._improve_policy(costs, seen, over)
        self._improve_critic(costs.detach(), seen.detach(), over)
        return norm

    def _values(self, seen: Float[Tensor, "*batch n_o"], over: Bool[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """What the slow critic estimates, or the value of an end."""
        end = (self.twin.plant.end_cost or 0.0) / self.reference
        return torch.where(over, end, self.target(seen).squeeze(-1))

    def _improve_policy(
        self, costs: Float[Tensor, "batch n"], seen: Float[Tensor, "batch m n_o"], over: Bool[Tensor, "batch m"]
    ) -> float:
        gamma, n = self.discount, costs.shape[1]
        weights = (1.0 - gamma) * gamma ** torch.arange(n, dtype=costs.dtype, device=costs.device)
        J_w = (costs * weights).sum(-1) + gamma**n * self._values(seen[:, -1], over[:, -1])
        self._optimiser.zero_grad(set_to_none=True)
        J_w.mean().backward()
        norm = nn.utils.clip_grad_norm_(self.learner.parameters(), self.gradient_limit)
        self._optimiser.step()
        return norm.item()

    def _improve_critic(
        self, costs: Float[Tensor, "batch n"], seen: Float[Tensor, "batch m n_o"], over: Bool[Tensor, "batch m"]
    ) -> None:
        targets = self._targets(costs, seen, over)
        for _ in range(self.critic_iterations):
            errors = self.critic(seen[:, :-1]).squeeze(-1) - targets
            loss = errors[~over[:, :-1]].square().mean()
            self._critic_optimiser.zero_grad(set_to_none=True)
            loss.backward()
            self._critic_optimiser.step()
        with torch.no_grad():
            for slow, fast in zip(self.target.parameters(), self.critic.parameters(), strict=True):
                slow.lerp_(fast, self.target_rate)

    @torch.no_grad()
    def _targets(
        self, costs: Float[Tensor, "batch n"], seen: Float[Tensor, "batch m n_o"], over: Bool[Tensor, "batch m"]
    ) -> Float[Tensor, "batch n"]:
        """The critic's targets (1 − γ)L_k + γ((1 − λ)v(e_{k+1}) + λ·target_{k+1}), computed from the last interval."""
        gamma, mixing = self.discount, self.mixing
        values = self._values(seen, over)
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
