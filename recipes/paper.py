"""The paper's algorithm on one screen, from parts of the library and of TorchRL, with its lines in the comments.

``--preset paper`` of the recipe of a plant trains with the same numbers, beside checkpoints, results and figures.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import rt_torchrl as rt

rt.begin_loading(__name__)

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector
from torchrl.modules import ValueOperator
from torchrl.objectives import DDPGLoss

from rt_torchrl.optimisers.descent import Descent
from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.steps.inputs import ExogenousProcess, sample_experience
from rt_torchrl.steps.learn import AT_ONCE, TRANSITION, Critic, ScaledPolicy
from rt_torchrl.steps.memory import LongTermMemory
from rt_torchrl.steps.report import weight_change
from rt_torchrl.steps.switch import STALL
from rt_torchrl.systems.collectors import collector_of
from rt_torchrl.systems.exploration import LivePolicy


@dataclass(frozen=True, kw_only=True)
class Config:
    """Run the paper's algorithm on one of its plants.

    Args:
        plant: the plant.
        seed: seed of weights, disturbances, exploration and samples.
        episodes: number n_e of real episodes.
    """

    plant: Literal["wind_turbine", "flapping_wing", "cryogenic_tank"] = "wind_turbine"
    seed: int = 0
    episodes: int = 20


def twinning(options: rt.RunConfig) -> Iterator[dict[str, float | str]]:
    """Train a twin and two policies; after each episode the costs and the decision.

    Args:
        options: plant, seed, number of episodes and, in ``twinning``, the hyper-parameters of Table 1.
    """
    plant, table = options.plant(), options.twinning
    generator = torch.Generator().manual_seed(options.seed)
    policies = options.make_policies(plant, generator)  # l. 1
    live, idle = "model_free", "model_based"
    closure = options.make_closure(plant, generator)  # l. 3
    twin = rt.DigitalTwin(plant, closure)
    learner = DDPG(plant, policies["model_free"], table.learner, generator)  # l. 2, with D_L of l. 4
    fit, plan = Descent(closure, rt.DescentConfig()), Descent(policies["model_based"], table.planner.descent)
    acting = LivePolicy(plant, policies[live], table.exploration, generator=generator)
    collector = collector_of(rt.PlantEnv(plant, seed=options.seed), acting, plant)
    worse, stalled = 0, 0  # C_π and C_w of l. 5
    inputs = plant.acting_inputs

    for i in range(options.episodes):
        before = {role: parameters_to_vector(policy.parameters()).detach() for role, policy in policies.items()}

        # Step 1, l. 7 to 13: a real episode; its record is D_S, because n_S = 1.
        acting.begin(policies[live], strength=table.exploration.strength(i))
        flown = collector.rollout()[0]
        flown["action"] = flown["next", "applied"]  # after the limits of the actuators
        states = torch.cat([flown["state"], flown["next", "state"][-1:]])
        learner.store(flown)

        # Step 2, l. 14 to 24: critic, then policy.
        learner.train_critic()
        learner.train_policy()

        # Step 3, l. 26: the process of the exogenous inputs.
        process = ExogenousProcess.of(flown["exogenous"][:, : len(inputs)], signals=inputs, config=table.exogenous)

        # Step 4, l. 27 to 36: the twin replays the record under N_z draws of the inputs.
        z = plant.with_previews(process.sample(table.realisations, generator))
        real, actions = (part.expand(len(z), -1, -1) for part in (states, flown["action"]))

        def J_p(z: Tensor = z, real: Tensor = real, actions: Tensor = actions) -> Tensor:
            return rt.identification_cost(plant, twin.replay(real[:, 0], z, actions), real).mean()

        assimilated = fit.run(J_p, table.assimilation.iterations, stop_below=table.assimilation.stop_below)

        # Step 5, l. 37 to 43: π_mb descends J_a on the twin, from the record's initial state.
        count = table.planner.realisations or table.realisations
        z = plant.with_previews(sample_experience([process], count, generator))

        def J_a(z: Tensor = z, start: Tensor = states[:1]) -> Tensor:
            return twin.cost(policies["model_based"], start.repeat(len(z), 1), z)

        planned = plan.run(J_a, table.planner.iterations)

        # Step 6, l. 44 to 47 and the decision tree: both policies on N virtual episodes with random initial states.
        count, change = table.virtual_episodes, weight_change(policies[idle], before[idle])
        start = plant.draw_initial_state(count, generator)
        z = plant.with_previews(sample_experience([process], count, generator))
        with torch.no_grad():
            cost = {role: twin.cost(policy, start, z).item() for role, policy in policies.items()}
        event, referee = "keep", table.referee
        if cost[live] > cost[idle]:
            worse, stalled = worse + 1, 0
            if worse > referee.patience:
                event, worse = "swap", 0
                live, idle = idle, live
        else:
            worse = 0
            stalled = stalled + 1 if change < STALL else 0
            if stalled > referee.clone_patience:
                event, stalled = "clone", 0
                policies[idle].load_state_dict(policies[live].state_dict())
                (learner if idle == "model_free" else plan).restart()
        yield {
            "real_cost": -flown["next", "reward"].mean().item(),
            "J_p_before": assimilated.start,
            "J_p": assimilated.best,
            "J_a_plan": planned.best,
            "J_a_model_based": cost["model_based"],
            "J_a_model_free": cost["model_free"],
            "event": event,
        }


class DDPG:
    """π_mf, its critic q and the memory D_L; line 17 has no target network, and relaxes the critic itself."""

    def __init__(self, plant: rt.Plant, policy: nn.Module, config: rt.LearnerConfig, generator: torch.Generator):
        self.config, self.memory = config, LongTermMemory(correction=0.0, generator=generator)
        self.batch_size = min(config.batch_size, plant.n_steps)
        self.actor = ScaledPolicy(plant, policy, stochastic=False, device=generator.device)
        widths = (len(plant.observations) + len(plant.actions), *rt.ActorCritic.critic_hidden)
        self.critic = Critic(widths, generator=generator)
        self.loss = DDPGLoss(
            TensorDictModule(self.actor, ["observation"], ["action"]),
            ValueOperator(self.critic, in_keys=["observation", "action"]),
            loss_function="l2",
            delay_value=False,
        )
        self.loss.make_value_estimator(gamma=config.discount)
        named = [(name, weight) for name, weight in self.loss.named_parameters() if weight.requires_grad]
        self.w_q = [weight for name, weight in named if "value_network" in name]
        self.w_a = [weight for name, weight in named if "value_network" not in name]
        self.critic_adam = torch.optim.Adam(self.w_q, rt.ActorCritic.critic_rate, fused=True)
        self.restart()

    def restart(self) -> None:
        """Forget what the optimiser knows of the policy's earlier weights."""
        self.actor_adam = torch.optim.Adam(self.w_a, self.config.actor_rate, fused=True)

    @torch.no_grad()
    def store(self, flown: TensorDictBase) -> None:
        """Line 11: transitions with their TD errors, for actions scaled to [−1, 1]."""
        transitions = flown.select(*TRANSITION).clone()
        transitions["action"] = self.actor.scaled(transitions["action"])
        batch = transitions.copy()
        self.loss(batch)
        self.memory.store(transitions, batch["td_error"].sqrt().flatten())  # the loss reports δ²

    def train_critic(self) -> None:
        """Lines 14 to 19; fifty batches are drawn at once, after which their TD errors are refreshed (l. 18)."""
        for sample in self._draws(self.config.critic_iterations):
            errors = list[Tensor]()
            for batch in sample.split(self.batch_size):
                earlier = [weight.detach().clone() for weight in self.w_q]
                self._step(batch, "loss_value", self.critic_adam, self.w_q)
                errors.append(batch["td_error"].detach().sqrt().flatten())
                with torch.no_grad():
                    for weight, w in zip(self.w_q, earlier, strict=True):  # l. 17
                        weight.copy_(torch.lerp(w, weight, self.config.target_rate))
            self.memory.refresh(sample["index"], torch.cat(errors))

    def train_policy(self) -> None:
        """Lines 20 to 24."""
        for sample in self._draws(self.config.actor_iterations):
            for batch in sample.split(self.batch_size):
                self._step(batch, "loss_actor", self.actor_adam, self.w_a)

    def _draws(self, count: int) -> Iterator[TensorDictBase]:
        for first in range(0, count, AT_ONCE):
            yield self.memory.sample(min(AT_ONCE, count - first) * self.batch_size)

    def _step(self, batch: TensorDictBase, loss: str, optimiser: torch.optim.Adam, trained: list[nn.Parameter]) -> None:
        gradients = torch.autograd.grad(self.loss(batch)[loss], trained)
        for weight, gradient in zip(trained, gradients, strict=True):
            weight.grad = gradient
        optimiser.step()


def main(config: Config) -> None:
    recipe = load_recipe(Path(__file__).with_name(f"{config.plant}.py"))
    words = ["--preset", "paper", "--seed", str(config.seed), "--episodes", str(config.episodes)]
    for i, episode in enumerate(twinning(from_command_line(recipe.Config, words))):
        numbers = (f"{name} {value:.4g}" for name, value in episode.items() if not isinstance(value, str))
        print(f"episode {i + 1}: {', '.join(numbers)}, {episode['event']}", flush=True)


if __name__ == "__main__":
    rt.main_of(Config, main)
