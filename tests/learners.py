"""DDPG, TD3 and SAC of this library and of stable-baselines3: ``uv run --group nightly tests/learners.py``.

Both learn from the same number of real steps, on Gymnasium's pendulum and on the turbine, with as many updates after
each episode and with the same batches, widths of networks, rates, discounts, rewards and noise. What differs is each
library's own: replay, initial weights, units of the policy, order of updates, limit of the policy's gradient and
precision. With SAC, stable-baselines3 explores by the noise of its policy, and this library by that of its step 1.

The table has the return in 20 unseen episodes without noise, median and range over seeds, and the seconds of the
processor. The same command goes on where it was interrupted; it takes 20 minutes of an idle core.
"""

import argparse
import dataclasses
import statistics
import sys
import time
from functools import partial
from itertools import product
from pathlib import Path

import gymnasium
import numpy as np
import stable_baselines3
import torch
from peers import Environment, Learned
from ruler import kept
from stable_baselines3.common.noise import NormalActionNoise
from torch import nn

import rt_torchrl as rt
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.pendulum.real import gymnasium_pendulum
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.evaluation.unseen import UNSEEN_SEED
from rt_torchrl.plants.policies import SaturatedMLP

ALGORITHMS = ("ddpg", "td3", "sac")
EPISODES = 20
RATES = {"actor_rate": rt.ActorCritic.critic_rate, "target_rate": 0.02}
SYSTEMS = {
    "pendulum": (
        Pendulum(),
        gymnasium_pendulum,
        rt.ExplorationConfig(spread=0.1, episodes=10**9),
        rt.LearnerConfig(critic_iterations=200, actor_iterations=200, reward_scale=0.1, **RATES),
    ),
    "turbine": (
        WindTurbine(horizon=200.0, observe=("measured+wind",)),
        rt.PlantEnv,
        rt.ExplorationConfig(spread=0.2, episodes=10**9),
        rt.LearnerConfig(critic_iterations=100, actor_iterations=100, return_steps=10, **RATES),
    ),
}
"""Plant, real system, noise, which does not fade, and what both learners are given."""


def of_this_library(plant, real, exploration, learner, seed):
    """A policy of the arm ``model_free``."""
    generator = torch.Generator().manual_seed(seed)
    widths = {"hidden": rt.ActorCritic.critic_hidden, "generator": generator}
    policies = [SaturatedMLP(len(plant.observations), plant.actions, **widths) for _ in range(2)]
    training = rt.ReinforcementTwinning(
        real(plant, seed=seed),
        rt.DigitalTwin(plant, plant.make_closure(generator)),
        model_free=policies[0],
        model_based=policies[1],
        config=rt.TwinningConfig(arm="model_free", exploration=exploration, learner=learner),
        generator=generator,
    )
    for _ in range(EPISODES):
        training.episode()
    return policies[0]


def of_stable_baselines3(plant, real, exploration, learner, seed):
    """A policy of stable-baselines3, which learns after each episode, too."""
    env, n_a = Environment(real(plant, seed=seed)), len(plant.actions)
    noise = {"action_noise": NormalActionNoise(np.zeros(n_a), np.full(n_a, exploration.spread))}
    agent = getattr(stable_baselines3, learner.algorithm.upper())(
        "MlpPolicy",
        gymnasium.wrappers.TransformReward(env, lambda reward: learner.reward_scale * reward),
        learning_rate=rt.ActorCritic.critic_rate,
        learning_starts=0,
        batch_size=learner.batch_size,
        tau=learner.target_rate,
        gamma=learner.discount,
        train_freq=(1, "episode"),
        gradient_steps=learner.critic_iterations,
        n_steps=learner.return_steps,
        policy_kwargs={"net_arch": list(rt.ActorCritic.critic_hidden), "activation_fn": nn.SiLU},
        seed=seed,
        device="cpu",
        **({} if learner.algorithm == "sac" else noise),
    )
    agent.learn(EPISODES * plant.n_steps)
    return Learned(agent, env)


IMPLEMENTATIONS = {"rt_torchrl": of_this_library, "stable-baselines3": of_stable_baselines3}


@torch.no_grad()
def mean_return(plant, policy):
    """Mean sum of the rewards in 20 unseen episodes; the pendulum of this library steps as Gymnasium's does."""
    env = rt.PlantEnv(plant, seed=UNSEEN_SEED)
    act = lambda td: td.set("action", policy(td["observation"]))  # noqa: E731
    return sum(env.rollout(plant.n_steps, act)["next", "reward"].sum().item() for _ in range(20)) / 20


def train(name, algorithm, implementation, seed):
    """Return and seconds of a training."""
    plant, real, exploration, learner = SYSTEMS[name]
    start = time.process_time()
    learner = dataclasses.replace(learner, algorithm=algorithm)
    policy = IMPLEMENTATIONS[implementation](plant, real, exploration, learner, seed)
    seconds = time.process_time() - start
    return mean_return(plant, policy), seconds


def line(name, algorithm, results):
    """A row of the table."""
    returns, seconds = zip(*(zip(*of_seeds, strict=True) for of_seeds in results), strict=True)
    overlap = max(map(min, returns)) <= min(map(max, returns))
    cells = [f"{statistics.median(values):.4g} ({min(values):.4g} … {max(values):.4g})" for values in returns]
    cells += ["yes" if overlap else "no", *(f"{statistics.median(values):.0f}" for values in seconds)]
    return f"| {name} | {algorithm} | {' | '.join(cells)} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--folder", type=Path, default=Path("runs/learners"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    results = {}
    for seed, name, algorithm, implementation in product(range(options.seeds), SYSTEMS, ALGORITHMS, IMPLEMENTATIONS):
        file = options.folder / f"{name}-{algorithm}-{implementation}-{seed}.json"
        result = kept(file, partial(train, name, algorithm, implementation, seed))
        results.setdefault((name, algorithm), {}).setdefault(implementation, []).append(result)
        print(file.stem, result, file=sys.stderr, flush=True)
    first, second = IMPLEMENTATIONS
    print(f"| system | algorithm | {first} | {second} | overlap | seconds, {first} | seconds, {second} |")
    print("|---|---|---|---|---|---|---|")
    for (name, algorithm), of_both in results.items():
        print(line(name, algorithm, of_both.values()))


if __name__ == "__main__":
    main()
