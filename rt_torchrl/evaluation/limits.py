"""The limit of a plant's cost, the best of a class of policies, and how far controllers are from it."""

import copy
import dataclasses
import math
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.control.command_cost import BoundedDescentConfig
from rt_torchrl.control.forecasts import Decaying, Forecast, Foreseen, Held, Scattered
from rt_torchrl.control.predictive_control import FUTURES, PredictiveConfig, RecedingHorizon
from rt_torchrl.evaluation.clairvoyant import clairvoyant, constant_starts, random_start
from rt_torchrl.evaluation.unseen import UNSEEN_SEED, UnseenEpisodes
from rt_torchrl.optimisers.descent import Descent, DescentConfig, by_small_steps
from rt_torchrl.optimisers.levenberg_marquardt import place
from rt_torchrl.options import AtLeastOne, configuration
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Actions, Inputs
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.rollout import DivergenceError, Rollout
from rt_torchrl.trajectories.trajectory import Trajectory

RECORDS = 20
"""Number of episodes, with other draws, whose inputs a forecast is fitted to."""
RECORDS_SEED = 0
REST = 0.2
"""Longest part of an episode, as a share of it, in which a start may rest at its end."""


@configuration
class LimitConfig:
    """How the limit of a plant's cost is computed, and model predictive control beside it.

    Args:
        starts: controllers whose flights the descents to the limit start from, by name.
        resting: names of those that rest at the end of an episode; see :func:`resting_at_the_end`.
        hold: number of control intervals for which a command of the optimum is held.
        window: parameters of model predictive control; None where gradients find no plans.
        descent: parameters of the descents.

    Raises:
        ValueError: if an option does not fit its type, or ``hold`` is not positive.
    """

    starts: Mapping[str, type[ClassicalController]]
    resting: tuple[str, ...] = ()
    hold: AtLeastOne = 1
    window: PredictiveConfig | None = None
    descent: BoundedDescentConfig = field(
        default_factory=lambda: BoundedDescentConfig(iterations=3000, tolerance=1e-13)
    )


@dataclass(frozen=True, kw_only=True)
class Contender:
    """What one controller costs, and what it makes of the episodes.

    Args:
        costs: J_a of each episode.
        merit: mean of each of the plant's own quantities.
        details: further results.
    """

    costs: list[float]
    merit: dict[str, float]
    details: dict[str, Any]

    @property
    def mean(self) -> float:
        """Mean J_a of all episodes."""
        return statistics.fmean(self.costs)


def judged(episodes: UnseenEpisodes, flown: Trajectory, **details: Any) -> Contender:
    """The contender that has flown the episodes."""
    costs, merit = episodes.judge(flown)
    means = {name: values.mean().item() for name, values in merit.items()}
    return Contender(costs=costs.tolist(), merit=means, details=details)


def limit(
    episodes: UnseenEpisodes, starts: Mapping[str, Actions], *, hold: int, config: BoundedDescentConfig
) -> Contender:
    """The clairvoyant optimum from commands by name, see :func:`clairvoyant`, with what says that it is an optimum."""
    plant, state, exogenous = episodes.plant, episodes.initial_state, episodes.exogenous
    found = clairvoyant(plant, state, exogenous, starts, closure=episodes.known_closure(), hold=hold, config=config)
    evidence = {
        "projected_gradient": found.gradient.max().item(),
        "excess": found.excess,
        "above_the_best": found.spread(),
        "gradients": found.gradients,
    }
    return judged(episodes, found.flown, **evidence)


def flown_starts(episodes: UnseenEpisodes, config: LimitConfig) -> dict[str, Actions]:
    """The commands of the controllers, some of which rest at the end."""
    starts = {}
    for name, kind in config.starts.items():
        flown = episodes.fly(kind(episodes.physics)).actions
        if name in config.resting:
            starts[f"{name}, resting"] = resting_at_the_end(episodes, flown)
        else:
            starts[name] = flown
    return starts


def few_starts(episodes: UnseenEpisodes, config: LimitConfig) -> dict[str, Actions]:
    """The commands of the controllers, and the middle of all ranges, where a descent knows nothing of them."""
    middle = constant_starts(episodes.plant, len(episodes.initial_state), episodes.plant.n_steps)["constant 0.5"]
    return flown_starts(episodes, config) | {"constant 0.5": middle}


def general_starts(episodes: UnseenEpisodes, *, seed: int) -> dict[str, Actions]:
    """Constant commands, and random ones of a seed."""
    plant, generator = episodes.plant, torch.Generator().manual_seed(seed)
    shape = len(episodes.initial_state), plant.n_steps
    return constant_starts(plant, *shape) | {"random 0": random_start(plant, *shape, generator=generator)}


def resting_at_the_end(episodes: UnseenEpisodes, commands: Actions) -> Actions:
    """The commands, but the least ones for the last part of each episode, which is as long as costs least.

    Nobody pays for the state at the end of an episode, so that an optimum may rest there; a descent from commands that
    act until the end hardly finds it. Twenty-five lengths are tried.
    """
    rollout = Rollout(episodes.plant, episodes.known_closure())
    low, n = bounds(episodes.plant.actions)[0], commands.shape[1]
    ends = [round(n * (1.0 - REST * k / 25)) for k in range(26)]
    tried = [torch.cat([commands[:, :end], low.expand(len(commands), n - end, -1)], 1) for end in ends]
    costs = torch.stack([rollout.costs(episodes.initial_state, episodes.exogenous, each) for each in tried])
    return torch.stack([tried[k][episode] for episode, k in enumerate(costs.argmin(0).tolist())])


def fitting(window: PredictiveConfig, plant: Plant) -> PredictiveConfig:
    """The window, or one that is as long as the plant's episodes where these are shorter.

    Raises:
        ValueError: if an episode is shorter than the time between two plans.
    """
    unit = max(plant.dt if seconds is None else seconds for seconds in (window.hold, window.period))
    longest = unit * math.floor(plant.horizon / unit + 1e-9)
    if not longest:
        raise ValueError(
            f"horizon={plant.horizon:g} s of plant {plant.name!r} is shorter than the {unit:g} s between two plans of "
            "model predictive control; take longer episodes."
        )
    return dataclasses.replace(window, horizon=min(window.length(plant), longest))


def receding(
    episodes: UnseenEpisodes, model: Plant, closure: nn.Module, config: PredictiveConfig, forecast: Forecast
) -> Contender:
    """Model predictive control on a model with a closure, such as those of the system, or those of a twin."""
    exact = episodes.known_closure()
    controller = RecedingHorizon(model, closure, config, forecast=forecast)
    flown = controller.fly(episodes.initial_state, episodes.exogenous, exact, plant=episodes.plant)
    batch, solves = len(episodes.initial_state), controller.solves
    seconds = [solve.seconds for solve in solves[batch:]]  # the first solves trace the programs
    milliseconds = {"median": 1e3 * statistics.median(seconds), "max": 1e3 * max(seconds)}
    gradients = statistics.median(solve.gradients for solve in solves)
    late = sum(solve.late for solve in solves)
    return judged(episodes, flown, milliseconds=milliseconds, gradients=gradients, late=late)


def predictive(episodes: UnseenEpisodes, window: PredictiveConfig) -> Contender:
    """Model predictive control on the exact model, with its own forecast; see :func:`receding`."""
    window = fitting(window, episodes.plant)
    known = forecasts(episodes.plant, episodes.exogenous, window)
    return receding(episodes, episodes.plant, episodes.known_closure(), window, known[window.forecast])


def forecasts(plant: Plant, exogenous: Inputs, window: PredictiveConfig) -> dict[str, Forecast]:
    """The forecasts that are compared: held, decaying to the mean as other episodes do, with its scatter, and known.

    A plant without inputs has nothing to forecast; all of them are one there.
    """
    if not plant.inputs:
        return dict.fromkeys(("held", "decaying", "scattered", "preview"), Held())
    records = plant.draw_exogenous(RECORDS, torch.Generator().manual_seed(RECORDS_SEED))
    over = {"dt": plant.dt, "horizon": min(window.length(plant), 0.5 * plant.horizon)}
    decaying = Decaying.fitted(records, **over)
    directions = round(over["horizon"] / plant.dt) * len(plant.inputs)
    scattered = Scattered.fitted(decaying, records, **over, pairs=min(FUTURES, directions))
    return {"held": Held(), "decaying": decaying, "scattered": scattered, "preview": Foreseen(exogenous, dt=plant.dt)}


@torch.no_grad()
def untrained_costs(
    unseen: UnseenEpisodes, make_policy: Callable[[torch.Generator], nn.Module], *, starts: int
) -> Float[Tensor, " {starts}"]:
    """Mean J_a of random initial policies; a training's cost over it does not depend on the training's own start.

    Args:
        unseen: the unseen episodes.
        make_policy: function that draws a random policy of the class.
        starts: number of policies.
    """
    device = unseen.initial_state.device
    generator = torch.Generator(device=device).manual_seed(UNSEEN_SEED)
    costs = [unseen.control_costs(make_policy(generator).to(device)).mean().item() for _ in range(starts)]
    return torch.tensor(costs, dtype=torch.float64, device=device)


TO_THE_END = DescentConfig(optimiser="lbfgs", rate=1.0)
FOR_PERCEPTRONS = {"approach": 600, "iterations": 300, "polish": 150}
"""Numbers of gradients with which three starts of a small perceptron end within 3 % of each other."""
DIRECT = 20
"""Greatest number of weights that are also searched without gradients."""
FOR_FEW_WEIGHTS = {"approach": 0, "iterations": 80, "polish": 20}
"""Numbers of gradients of a policy with no more weights."""
ENOUGH, POLISH = 80, 20
"""Numbers of costs for each weight of that search, on a few episodes and on all."""


class Optimum(NamedTuple):
    """Best mean J_a found, its policy, the cost that each start reached on the first few episodes, and by gradients.

    ``by_gradients`` is the mean J_a that exact gradients reach alone. It is greater where the plant is not smooth.
    """

    cost: float
    policy: nn.Module
    costs: list[float]
    by_gradients: float


def exact_optimum(
    unseen: UnseenEpisodes,
    make_policy: Callable[[torch.Generator], nn.Module],
    *,
    starts: int = 3,
    iterations: int | None = None,
    few: int = 10,
    polish: int | None = None,
    approach: int | None = None,
    seed: int = UNSEEN_SEED,
) -> Optimum:
    """The best policy of a class, found on the *true* plant and on the unseen episodes themselves.

    Every start descends by exact gradients on a few episodes, because a gradient over a hundred episodes takes ten
    times as long and has the same direction as one over ten. The best start goes on with all episodes. Up to twenty
    weights are then searched by the simplex of Nelder and Mead, from the best two: exact gradients stay in the next
    poor minimum of a plant with rate limits, play or stiction.

    Args:
        unseen: the unseen episodes.
        make_policy: function that draws a random policy of the class.
        starts: number of random initial policies.
        iterations: gradients of L-BFGS from each start, on the first ``few`` episodes; by default 80, or 300 for more
            than twenty weights.
        few: number of episodes on which every start descends.
        polish: gradients of the best start, on all episodes; by default 20, or 150 for more than twenty weights.
        approach: gradients of Adam from each start before those of L-BFGS; by default none, or 600 for more than twenty
            weights. L-BFGS alone takes perceptrons to the next poor minimum.
        seed: seed of the initial weights.
    """
    generator = torch.Generator(device=unseen.initial_state.device).manual_seed(seed)

    def descend(policy: nn.Module, count: int, steps: int, *, approaching: int = 0) -> float:
        rollout = unseen.rollout(policy)
        state, exogenous = unseen.initial_state[:count], unseen.exogenous[:count]

        def cost() -> Tensor:
            return rollout.costs(state, exogenous).mean()

        if approaching:
            by_small_steps(policy, cost, approaching)
        return Descent(policy, TO_THE_END).run(cost, steps).best

    policies = [make_policy(generator).to(unseen.initial_state.device) for _ in range(starts)]
    count = sum(weight.numel() for weight in policies[0].parameters() if weight.requires_grad)
    usual = FOR_PERCEPTRONS if count > DIRECT else FOR_FEW_WEIGHTS
    asked = {"approach": approach, "iterations": iterations, "polish": polish}
    effort = {name: usual[name] if number is None else number for name, number in asked.items()}
    costs = [descend(policy, few, effort["iterations"], approaching=effort["approach"]) for policy in policies]
    best, *others = (policies[k] for k in sorted(range(starts), key=costs.__getitem__))
    by_gradients = descend(best, len(unseen.initial_state), effort["polish"])
    found = [(by_gradients, best)]
    if 0 < count <= DIRECT:
        for policy in (copy.deepcopy(best), *others[:1]):
            by_simplex(unseen.first(few), policy, count * ENOUGH, size=0.3)
            found.append((by_simplex(unseen, policy, count * POLISH, size=0.05), policy))
    return Optimum(*min(found, key=lambda pair: pair[0]), costs, by_gradients)


def by_simplex(unseen: UnseenEpisodes, policy: nn.Module, count: int, *, size: float) -> float:
    """Search the weights of a policy without gradients; it gets the best ones.

    Args:
        unseen: the episodes, whose mean J_a is searched.
        policy: the policy.
        count: greatest number of costs.
        size: size of the first simplex, as a share of each weight.
    """
    from scipy.optimize import minimize  # here, because the options of a recipe need not wait for it

    weights = [weight for weight in policy.parameters() if weight.requires_grad]
    start = parameters_to_vector(weights).detach()
    scale, rollout = size * start.abs().clamp_min(0.1), unseen.rollout(policy)

    @torch.no_grad()
    def cost(shares: np.ndarray) -> float:
        place(start + scale * torch.as_tensor(shares, device=start.device), weights)
        try:
            value = rollout.costs(unseen.initial_state, unseen.exogenous).mean().item()
        except DivergenceError:
            return math.inf
        return value if math.isfinite(value) else math.inf

    simplex = np.concatenate([np.zeros((1, len(start))), np.eye(len(start))])
    options = {"maxfev": count, "initial_simplex": simplex, "adaptive": True, "xatol": 1e-6, "fatol": 1e-12}
    found = minimize(cost, simplex[0], method="Nelder-Mead", options=options)
    return cost(found.x)
