"""Controllers of others beside a recipe, on the same real system: ``uv run --group nightly tests/peers.py reactor``.

The classical controller of the recipe, do-mpc with the coefficients of the data sheet and with those that the twin has
found, and a learner of stable-baselines3 after as many real episodes and after ``--times`` as many fly the episodes
that judge the recipe's live policy. The table has J_a of these, the costs of all real episodes before them, the
seconds of the training, and the lines of code. The same command goes on where it was interrupted; another folder is
another measurement.
"""

import argparse
import importlib
import inspect
import json
import operator
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import casadi as ca
import do_mpc
import gymnasium
import numpy as np
import stable_baselines3
import torch
from ruler import RECIPES, kept, span, train
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from torch import nn

from rt_torchrl import load_run
from rt_torchrl.evaluation.unseen import RealEpisodes

sys.path.insert(0, str(RECIPES))


class System(NamedTuple):
    """A recipe with a ``Config``, ``real_system(plant, seed=)`` and a classical controller, and its model in CasADi.

    ``rates(c, s, a, z)`` is ds/dt and ``cost(s, a, z)`` is L_a, by coefficients, state, action and inputs; do-mpc plans
    over ``horizon`` intervals. ``true`` are the coefficients of the real system, where somebody knows them.
    """

    classical: str
    rates: Callable
    cost: Callable
    horizon: int
    true: tuple[float, ...] = ()


def reactor_rates(c, s, a, z):
    reaction = c[0] * ca.exp(c[1] * (1.0 / 325.0 - 1.0 / s[1])) * s[0]
    warming = 5e4 / 239.0 * reaction + c[2] * (a[0] - s[1])
    return ca.vertcat((1.0 - s[0]) / 60.0 - reaction, (z[1] - s[1]) / 60.0 + warming)


def reactor_cost(s, a, z):
    return 1e3 * (s[0] - z[0]) ** 2


def drive_rates(c, s, a, z):
    torque = c[0] * s[1] ** 2 - c[2] * s[0] - c[3] * s[0] * ca.fabs(s[0])
    return ca.vertcat(torque / c[1], (a[0] - 0.064 * s[1] - c[0] * s[0] * s[1]) / 5.419e-3)


def drive_cost(s, a, z):
    return ca.sqrt(1.0 + ((z[0] - s[0]) / 10.0) ** 2) - 1.0 + 100.0 * ca.fmax(s[1] / 150.0 - 1.0, 0.0) ** 2


def double_pendulum_rates(c, s, a, z):
    import double_pendulum as p

    lower, upper, coupling = s[1], s[1] + s[2], p.UPPER * p.LENGTH
    first, second, both = s[4], s[5], s[4] + s[5]
    rows = (
        (p.TOTAL, p.BOTH * ca.cos(lower), p.UPPER * ca.cos(upper)),
        (p.BOTH * ca.cos(lower), p.SWUNG, coupling * ca.cos(s[2])),
        (p.UPPER * ca.cos(upper), coupling * ca.cos(s[2]), p.TURNED),
    )
    forces = ca.vertcat(
        c[0] * a - c[1] * s[3] + p.BOTH * ca.sin(lower) * first**2 + p.UPPER * ca.sin(upper) * both**2,
        p.BOTH * p.GRAVITY * ca.sin(lower) + coupling * ca.sin(s[2]) * both**2 - c[2] * (first - second),
        p.UPPER * p.GRAVITY * ca.sin(upper) - coupling * ca.sin(s[2]) * first**2 - c[2] * second,
    )
    up = ca.solve(ca.vertcat(*(ca.horzcat(*row) for row in rows)), forces)
    return ca.vertcat(s[3:], up[0], up[1], up[2] - up[1])


def double_pendulum_cost(s, a, z):
    lower, upper = s[1], s[1] + s[2]
    across, height = s[0] + 0.6 * (ca.sin(lower) + ca.sin(upper)), 0.6 * (ca.cos(lower) + ca.cos(upper))
    return 0.01 * across**2 + (height - 2.0) ** 2 - 0.64 + 1e-3 * s[4] ** 2 + 5e-3 * s[5] ** 2


SYSTEMS = {
    "reactor": System(
        "PI", reactor_rates, reactor_cost, 20, true=(7.2e10 / 60.0 * np.exp(-8750.0 / 325.0), 8750.0, 5e4 / 239e3 / 6.0)
    ),
    "drive": System("Cascade", drive_rates, drive_cost, 30, true=(1.7e-3, 3e-3, 0.01, 1e-4)),
    "double_pendulum": System("LQR", double_pendulum_rates, double_pendulum_cost, 40),
}


class Predictive(nn.Module):
    """do-mpc's controller of a plant, with the measured inputs held over its horizon."""

    def __init__(self, plant, system, coefficients):
        super().__init__()
        model = do_mpc.model.Model("continuous", "SX")
        s = model.set_variable("_x", "s", (len(plant.states), 1))
        a = model.set_variable("_u", "a", (len(plant.actions), 1))
        z = model.set_variable("_tvp", "z", (len(plant.inputs), 1))
        model.set_rhs("s", system.rates(coefficients, s, a, z))
        model.setup()
        self.mpc = do_mpc.controller.MPC(model)
        silent = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": 0}
        options = {"n_horizon": system.horizon, "t_step": plant.dt, "nlpsol_opts": silent}
        self.mpc.set_param(store_full_solution=False, **options)
        self.mpc.set_objective(mterm=ca.SX(0), lterm=system.cost(s, a, z))
        if plant.state_sizes:
            self.mpc.scaling["_x", "s"] = np.array(plant.state_sizes)
        self.mpc.bounds["lower", "_u", "a"] = [signal.low for signal in plant.actions]
        self.mpc.bounds["upper", "_u", "a"] = [signal.high for signal in plant.actions]
        self.inputs = self.mpc.get_tvp_template()
        self.mpc.set_tvp_fun(lambda t: self.inputs)
        self.mpc.setup()

    def begin(self):
        self.mpc.reset_history()
        self.begun = False

    def act(self, t, state, exogenous):
        if exogenous.numel():
            self.inputs["_tvp", :, "z"] = exogenous[0].numpy()
        if not self.begun:
            self.mpc.x0 = state[0].numpy()
            self.mpc.set_initial_guess()
            self.begun = True
        return torch.from_numpy(self.mpc.make_step(state[0].numpy().reshape(-1, 1))).reshape(1, -1)

    def fly(self, initial_state, exogenous, closure=None, *, plant=None):
        raise NotImplementedError("it flies the real system alone.")

    def report(self):
        return {}


class Environment(gymnasium.Env):
    """A real system as an environment of Gymnasium: the observation of the policies, the reward −L_a, actions in ±1."""

    def __init__(self, system):
        self.system, self.paid = system, []
        plant = system.plant
        self.low, self.high = (torch.tensor([getattr(a, end) for a in plant.actions]) for end in ("low", "high"))
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (len(plant.observations),))
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(plant.actions),))

    def reset(self, *, seed=None, options=None):
        self.present, self.interval = self.system.reset(), 0
        self.paid.append(0.0)
        return self.observed(), {}

    def step(self, action):
        plant = self.system.plant
        self.present["action"] = commanded(torch.from_numpy(action)[None], self.low, self.high)
        after = self.system.step(self.present)["next"]
        self.interval += 1
        reward = after["reward"].item()
        if after["terminated"].item():
            reward -= (plant.n_steps - self.interval) * plant.end_cost
        self.paid[-1] -= reward / plant.n_steps
        self.present = after.exclude("reward")
        return self.observed(), reward, after["terminated"].item(), after["truncated"].item(), {}

    def observed(self):
        return self.present["observation"][0].numpy().astype(np.float32)


def commanded(action, low, high):
    """The command in the plant's units for an action in ±1."""
    return low + 0.5 * (action.double() + 1.0) * (high - low)


class Learned(nn.Module):
    """A policy of stable-baselines3, without noise."""

    def __init__(self, learner, env):
        super().__init__()
        self.learner, self.env = learner, env

    def forward(self, observation):
        action, _ = self.learner.predict(observation.numpy().astype(np.float32), deterministic=True)
        return commanded(torch.from_numpy(action), self.env.low, self.env.high)


class Result(NamedTuple):
    """Mean J_a of the episodes that judge, Σ J_a and number of the real episodes before them, and seconds."""

    cost: float
    paid: float = 0.0
    episodes: int = 0
    seconds: float = 0.0


class Comparison:
    """One recipe and its peers, whose results are kept in a folder."""

    def __init__(self, name, folder, judged):
        self.name, self.folder, self.judged = name, folder / name, judged
        self.recipe, self.system = importlib.import_module(name), SYSTEMS[name]
        self.plant = self.recipe.Config().plant()

    def kept(self, row, seed, measure):
        """The result of a row, measured unless it is in the folder."""
        result = Result(*kept(self.folder / f"{row}, {seed}.json", partial(measure, seed)))
        print(f"{row}, seed {seed}: {result}", file=sys.stderr, flush=True)
        return result

    def cost(self, policy):
        """Mean J_a of the episodes that judge."""
        episodes = RealEpisodes(self.recipe.real_system(self.plant), self.judged)
        return episodes.control_costs(policy).mean().item()

    def trained(self, seed):
        """The folder of the recipe's training with default options, and the seconds of its process."""
        return train(self.name, ("--real-unseen", str(self.judged)), seed, self.folder / f"run-{seed}")

    def twinning(self, seed):
        folder = self.trained(seed)
        metrics = json.loads((folder / "metrics.json").read_text())
        summary = metrics["summary"]
        cost = summary["real_unseen"]["controllers"][summary["live"]]["J_a"]["mean"]
        learning = summary["cost_of_learning"]
        paid, judging = learning["sum"], learning["judging"]
        episodes = learning["episodes"] - len(judging)
        return Result(cost, paid - sum(judging), episodes, json.loads((folder / "seconds.json").read_text()))

    def classical(self, seed):
        return Result(self.cost(getattr(self.recipe, self.system.classical)(self.plant)))

    def data_sheet(self, seed):
        closure = self.plant.make_closure(torch.Generator())
        return self.predictive(closure.coefficients.tolist())

    def found(self, seed):
        coefficients = load_run(self.trained(seed)).closure.coefficients.tolist()
        return self.predictive(coefficients)._replace(episodes=self.twinning(seed).episodes)

    def true(self, seed):
        return self.predictive(self.system.true)

    def predictive(self, coefficients):
        return Result(self.cost(Predictive(self.plant, self.system, coefficients)))

    def beside(self, seed, *, times, algorithm):
        """A learner after this many times the real episodes of the recipe."""
        return self.learned(seed, algorithm, times * self.twinning(seed).episodes)

    def learned(self, seed, algorithm, episodes):
        """A learner of stable-baselines3 with its default options."""
        env = Environment(self.recipe.real_system(self.plant, seed=seed))
        learner = getattr(stable_baselines3, algorithm)("MlpPolicy", env, seed=seed, device="cpu")
        start = time.perf_counter()
        # Episodes may end early: they are counted, not their intervals.
        learner.learn(10**9, StopTrainingOnMaxEpisodes(episodes))
        seconds = time.perf_counter() - start
        done = env.paid[:-1]  # an episode begins when the last one has ended
        return Result(self.cost(Learned(learner, env)), sum(done), len(done), seconds)

    def lines(self):
        """Lines of code of each part, see :func:`code_lines`."""
        wiring, law = (code_lines(getattr(self.recipe, name)) for name in ("real_system", self.system.classical))
        recipe = code_lines(self.recipe) - wiring - law
        predictive = code_lines(Predictive) + code_lines(self.system.rates) + code_lines(self.system.cost)
        learner = code_lines(Environment) + code_lines(Learned) + code_lines(Comparison.learned)
        return {"twinning": recipe, "classical": law, "do-mpc": predictive, "learner": learner, "wiring": wiring}


def code_lines(part):
    """Number of lines of a part that are neither blank nor comments."""
    lines = (line.strip() for line in inspect.getsource(part).splitlines())
    return sum(bool(line) and not line.startswith("#") for line in lines)


def row(name, results, lines):
    """A row of the table: over seeds, least and greatest cost and sum, and the median of the seconds."""
    costs, paid, episodes, seconds = zip(*results, strict=True)
    sums = span(paid, 3) if any(paid) else "–"
    time_taken = f"{statistics.median(seconds):.0f}" if any(seconds) else "–"
    return f"| {name} | {len(results)} | {span(costs, 4)} | {sums} | {span(episodes, 4)} | {time_taken} | {lines} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("system", choices=list(SYSTEMS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--long-seeds", type=int, default=1, help="seeds of the learner with more episodes")
    parser.add_argument("--times", type=int, default=50, help="how many times as many episodes it takes there")
    parser.add_argument("--learner", default="SAC", choices=["SAC", "TD3"])
    parser.add_argument("--judged", type=int, default=20, help="episodes that judge")
    parser.add_argument("--folder", type=Path, default=Path("runs/peers"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    comparison = Comparison(options.system, options.folder, options.judged)
    seeds, longer = range(options.seeds), range(options.long_seeds)
    lines, learner = comparison.lines(), options.learner
    rows = [("twinning", comparison.twinning, seeds, "twinning")]
    rows += [(comparison.system.classical, comparison.classical, [0], "classical")]
    rows += [("do-mpc, data sheet", comparison.data_sheet, [0], "do-mpc")]
    rows += [("do-mpc, coefficients of the twin", comparison.found, seeds, "do-mpc")]
    if comparison.system.true:
        rows += [("do-mpc, true coefficients", comparison.true, [0], "do-mpc")]
    for times, name, chosen in (
        (1, learner, seeds),
        (options.times, f"{learner}, {options.times} times the episodes", longer),
    ):
        rows += [(name, partial(comparison.beside, times=times, algorithm=learner), chosen, "learner")]
    print("| controller | seeds | J_a | Σ | real episodes | seconds | lines of code |")
    print("|---|---|---|---|---|---|---|")
    for name, measure, chosen, part in filter(operator.itemgetter(2), rows):
        results = [comparison.kept(name, seed, measure) for seed in chosen]
        print(row(name, results, lines[part]), flush=True)
    print(f"\nAll but do-mpc's own model use the wiring of {lines['wiring']} lines.")


if __name__ == "__main__":
    main()
