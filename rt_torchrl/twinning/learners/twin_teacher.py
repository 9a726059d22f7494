r"""What a twin teaches critics: slopes of the return along real states, and transitions of the present policy."""

import numpy as np
import torch
from jaxtyping import Float
from tensordict import TensorDict
from torch import Tensor, nn

from rt_torchrl.plants.plant import flight_costs
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.hypotheses.hidden_states import with_hidden_states
from rt_torchrl.twinning.learners.episode_memory import EpisodeMemory, windows
from rt_torchrl.twinning.learners.innovations import inputs_within

INSIDE = 1.0 - 1e-9
"""Share of an increment at which a slope is taken; at the very limit of an actuator there are two."""


class TwinTeacher:
    """A twin with the policy that the critics judge.

    Of several hypotheses the likeliest one teaches. Its hidden states follow from what the sensors read.

    Args:
        twin: the digital twin, whose closure other steps train.
        policy: policy π_mf.
        memory: real episodes along which the twin teaches.
    """

    def __init__(self, twin: DigitalTwin, policy: nn.Module, memory: EpisodeMemory):
        self.twin, self.policy, self.memory = twin, policy, memory

    def _whole(self, episode: TensorDict) -> Float[Tensor, "n n_s"]:
        """States of an episode with the hidden ones of the twin."""
        record = Trajectory(episode["state"], episode["action"][:-1], episode["exogenous"][:-1])
        return with_hidden_states(self.twin.believed, record).states

    def slopes(self, episode: TensorDict) -> Float[Tensor, "n n_a"]:
        r"""Slopes :math:`g_k = \partial J/\partial a_k` of the discounted sum of L_a by each applied action.

        .. math::
            g_k = L_a + \gamma\Phi_a^\top\lambda_{k+1}, \qquad
            \lambda_k = L_s + \pi_s^\top L_a + \gamma(\Phi_s + \Phi_a\pi_s)^\top\lambda_{k+1}

        They are taken along the real states, actions and inputs; after each action the policy acts. λ is zero at the
        end of the episode; the slopes do not see an early end coming.

        Args:
            episode: one of the memory's episodes, of n control intervals.
        """
        by_state, by_action, law, cost_by_state, cost_by_action = (
            part.cpu().numpy() for part in self._linearised(episode)
        )
        discount, costate = self.memory.discount, np.zeros(by_state.shape[-1])
        found = np.empty_like(cost_by_action)
        closed = by_state + by_action @ law
        held = cost_by_state + np.einsum("na,nas->ns", cost_by_action, law)
        for k in reversed(range(len(found))):
            found[k] = cost_by_action[k] + discount * (costate @ by_action[k])
            costate = held[k] + discount * (costate @ closed[k])
        return torch.from_numpy(found).to(episode.device)

    def _linearised(self, episode: TensorDict) -> tuple[Tensor, ...]:
        """Φ_s, Φ_a, π_s, L_s and L_a at every control interval."""
        twin, increments = self.twin.believed, self.memory.increments
        plant = twin.plant
        t = plant.dt * torch.arange(len(episode), dtype=torch.float64, device=episode.device)
        exogenous = episode["exogenous"]
        with torch.enable_grad():
            state = self._whole(episode).clone().requires_grad_()
            action = episode["action"].clone().requires_grad_()
            centre = increments.centre(episode["state"])
            end = plant.step(t, state, centre + INSIDE * (action - centre), exogenous, twin.closure).state
            cost = plant.running_cost(t, state, action, exogenous)
            acted = plant.actuate(state, self.policy(plant.observe(t, state, exogenous)))
            by_both = jacobian(end, (state, action))
            (law,) = jacobian(acted, (state,))
            costs = jacobian(cost.unsqueeze(-1), (state, action))
        return *by_both, law, *(part.squeeze(1) for part in costs)

    def decision_slopes(self, episode: TensorDict, at: Tensor, reward_scale: float) -> Float[Tensor, "n n_a"]:
        """Slopes dq/du of the values by the increments of decisions.

        Args:
            episode: one of the memory's episodes.
            at: control intervals at which the decisions begin.
            reward_scale: factor on the rewards.
        """
        slopes, weights = self.slopes(episode), self.memory.discounts(self.memory.intervals)
        if self.memory.over(episode):  # what is commanded after the end changes nothing
            slopes = torch.cat([slopes, slopes.new_zeros(len(weights), slopes.shape[-1])])
        sums = torch.stack([windows(part, weights)[at] for part in slopes.unbind(-1)], -1)
        return -reward_scale * self.memory.increments.scale * sums

    @torch.no_grad()
    def transitions(
        self, count: int, decisions: int, *, reward_scale: float, generator: torch.Generator
    ) -> TensorDict | None:
        """Virtual transitions from real states: the recorded decision, and then the present policy.

        They begin where the real episode went on for as long; where the twin ends early, its end counts.

        Args:
            count: number of transitions.
            decisions: number n of decisions of each.
            reward_scale: factor on the rewards.
            generator: source of the draws of states.

        Returns:
            The transitions; None if all real episodes ended too early for one.

        Raises:
            DivergenceError: if the twin diverges.
        """
        memory, n = self.memory, decisions * self.memory.intervals
        scales, parts = memory.statistics(), []
        law = memory.innovations(scales)
        long = [episode for episode in memory.episodes if len(memory.inner_places(episode, n))]
        for episode in long:
            share, places = -(-count // len(long)), memory.inner_places(episode, n)
            drawn = torch.randint(len(places), (share,), generator=generator, device=generator.device)
            at = places[drawn]
            now = memory.situation(episode, at, scales) | {"action": memory.taken(episode, at), "place": at}
            now["innovation"] = law(now["features"], inputs_within(episode, at, memory.intervals))
            now["next"] = self._flown(episode, at, n, scales, reward_scale)
            parts.append(TensorDict(now, batch_size=share, device=at.device))
        return torch.cat(parts)[:count] if parts else None

    def _flown(
        self, episode: TensorDict, at: Tensor, n: int, scales: tuple[Tensor, Tensor], reward_scale: float
    ) -> dict[str, Tensor]:
        twin, memory, m = self.twin.believed, self.memory, self.memory.intervals
        plant, read = twin.plant, len(self.twin.plant.states)
        ahead = at.unsqueeze(-1) + torch.arange(n, device=at.device)
        exogenous, start = episode["exogenous"][ahead], plant.dt * at.double()
        first = twin.replay(self._whole(episode)[at], exogenous[:, :m], episode["action"][ahead[:, :m]], start=start)
        states, actions = first.states, first.actions
        if n > m:
            after = twin.control(self.policy, states[:, -1], exogenous[:, m:], start=start + m * plant.dt)
            states, actions = torch.cat([states, after.states[:, 1:]], 1), torch.cat([actions, after.actions], 1)
        t = plant.dt * ahead.double()
        costs, ended = flight_costs(plant, t, states, actions, exogenous)
        rewards, discount = memory.closed(-costs @ memory.discounts(n), ended, n)
        end = TensorDict({"state": states[:, -1], "exogenous": episode["exogenous"][at + n]}, batch_size=len(at))
        end["observation"] = plant.observe(plant.dt * (at + n).double(), end["state"], end["exogenous"])
        end["state"] = end["state"][:, :read]  # the critics see what sensors read
        end["reward"] = rewards.unsqueeze(-1)  # its device and length say where the features are computed
        found = memory.situation(end, torch.arange(len(at), device=at.device), scales)
        return found | {"reward": reward_scale * end["reward"], "discount": discount.unsqueeze(-1)}


def jacobian(
    outputs: Float[Tensor, "n n_y"], inputs: tuple[Float[Tensor, "n _"], ...]
) -> tuple[Float[Tensor, "n n_y _"], ...]:
    """Derivatives of each output by the inputs of its row; zero for an input that it does not depend on."""
    rows = []
    for output in outputs.unbind(-1):
        if not output.requires_grad:
            rows.append(tuple(torch.zeros_like(x) for x in inputs))
            continue
        found = torch.autograd.grad(output.sum(), inputs, retain_graph=True, allow_unused=True)
        rows.append(tuple(torch.zeros_like(x) if g is None else g for x, g in zip(inputs, found, strict=True)))
    return tuple(torch.stack(parts, 1).detach() for parts in zip(*rows, strict=True))
