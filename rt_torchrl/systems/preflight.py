r"""The check of a real system's wiring before a training: one-step predictions of the twin beside readings.

Each interval of a short flight gives a state s, an action a, an input z and the state after it. The twin predicts that
state, :math:`\hat s_{k+1} = \Phi(s_k, a_k, z_k)`, and what it leaves unexplained of the movement of state i is

.. math:: q_i = \frac{\sum_k (s_{k+1} - \hat s_{k+1})_i^2}{\sum_k (s_{k+1} - s_k)_i^2}

The coefficients of the closure are fitted first, so that ordinary model error counts as little as it can. If too much
is left, the same is done for every mistake of a list. One that leaves much less, :math:`\sum_i \log q_i` lower by
``MARGIN``, is named.
"""

import copy
import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters
from torchrl.envs import EnvBase

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds, differences
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin

STARTS, INTERVALS = 3, 40
"""Number of starts, and of control intervals after each."""
ROWS = 200
"""Greatest number of intervals of a record that are looked at."""
EXPLAINED = 3e-3
"""Share of the movement of a state that a twin with fitted coefficients may leave unexplained without a question."""
FLOOR = 3e-4
"""Share below which a prediction counts as exact, whatever the digits of sensors and integrators."""
MARGIN = math.log(8.0)
"""Least gain of a mistake that is named, and by how much it must be ahead of others to be named alone."""
LARGE, WORST = 1e3, 1e6
"""Error, in movements, and share that stand for a prediction that is not finite."""
EVALUATIONS = 12
"""Greatest number of evaluations in a fit of the coefficients."""
FITTED = 12
"""Number of mistakes, the best ones under coefficients that are known, to which the coefficients are fitted."""
RATIOS = (0.1, 0.2, 0.25, 0.4, 0.5, 2.0, 2.5, 4.0, 5.0, 10.0)
"""Ratios of the real control interval to the plant's that are tried."""
CORRELATION = 3.0
"""Correlation time of the noise, in control intervals: noise that is new in each one hardly moves a slow plant."""
STILL, RESOLUTION = 1e-9, 1e-3
"""Movement of a state, as a share of its size: below the first it does not move, and beyond the second it shows."""
UNITS: dict[str, tuple[tuple[str, float, float], ...]] = {
    "rad": (("deg", math.pi / 180.0, 0.0),),
    "rad/s": (("deg/s", math.pi / 180.0, 0.0), ("rpm", math.pi / 30.0, 0.0)),
    "deg": (("rad", 180.0 / math.pi, 0.0),),
    "deg/s": (("rad/s", 180.0 / math.pi, 0.0),),
    "K": (("°C", 1.0, 273.15), ("°F", 5.0 / 9.0, 459.67 * 5.0 / 9.0)),
    "°C": (("K", 1.0, -273.15), ("°F", 5.0 / 9.0, -32.0 * 5.0 / 9.0)),
    "Pa": (("kPa", 1e3, 0.0), ("bar", 1e5, 0.0)),
    "m": (("mm", 1e-3, 0.0),),
    "m/s": (("km/h", 1.0 / 3.6, 0.0),),
    "m³": (("L", 1e-3, 0.0),),
    "W": (("kW", 1e3, 0.0),),
    "N": (("kN", 1e3, 0.0),),
    "N m": (("kN m", 1e3, 0.0),),
    "-": (("%", 1e-2, 0.0),),
}
"""For a unit of a plant, others in which a value may come, with their size in it and their zero."""
LEVELS = 5
"""Number of constant actions over the range of each that are tried."""


class WiringError(ValueError):
    """The real system does not fit its plant: a reading or a command is wired wrongly."""


class Flown(NamedTuple):
    """Control intervals of short flights, as they were read or as a mistake would have them; ``n`` rows each.

    The earlier actions and inputs are those of the interval before; ``ratio`` is the real control interval by the
    plant's.
    """

    t: Float[Tensor, " n"]
    states: Float[Tensor, "n n_s"]
    actions: Float[Tensor, "n n_a"]
    exogenous: Float[Tensor, "n n_z"]
    ends: Float[Tensor, "n n_s"]
    earlier_actions: Float[Tensor, "n n_a"]
    earlier_exogenous: Float[Tensor, "n n_z"]
    ratio: float = 1.0


class Suspicion(NamedTuple):
    """A wiring, as it is or with a mistake, and the share of each state's movement that it leaves unexplained."""

    mistake: str
    unexplained: Float[Tensor, " n_s"]
    error: Float[Tensor, " n_s"]

    @property
    def score(self) -> float:
        r""":math:`\sum_i \log q_i`, of the states that move."""
        return float(self.unexplained[self.unexplained.isfinite()].clamp(FLOOR, WORST).log().sum())


class Wiring(NamedTuple):
    """What the check has found.

    Args:
        plant: plant that gives the states.
        present: the wiring as it is; ``error`` is the RMS error of one-step predictions, in the units of the states.
        moved: RMS movement of each state in an interval, in its unit.
        mistakes: the readings that stand still where the twin moves, of which no other wiring is tried; or the mistakes
            that fit much better, the best one first. Empty if the wiring is right or nothing fits.
    """

    plant: Plant
    present: Suspicion
    moved: Float[Tensor, " n_s"]
    mistakes: tuple[Suspicion, ...]

    def __str__(self) -> str:
        rows = [f"one step of {self.plant.dt:g} s of plant {self.plant.name!r} beside the readings:"]
        signals = zip(self.plant.states, self.moved.tolist(), *self.present[1:], strict=True)
        for signal, moved, unexplained, error in signals:
            share = f"{100.0 * unexplained:.3g} % unexplained" if math.isfinite(unexplained) else "it does not move"
            rows.append(f"  {signal.name}: moves by {moved:.4g}, predicted to {error:.4g} {signal.unit}; {share}")
        for mistake in self.mistakes:
            shares = ", ".join(
                f"{signal.name} {100.0 * share:.3g} %"
                for signal, share in zip(self.plant.states, mistake.unexplained.tolist(), strict=True)
                if math.isfinite(share)
            )
            rows.append(
                f"  much less is unexplained if {mistake.mistake}: {shares}" if shares else f"  {mistake.mistake}"
            )
        return "\n".join(rows)

    def require(self) -> None:
        """Refuse a system whose wiring does not fit.

        Raises:
            WiringError: if a mistake fits much better, or a reading stands still where the twin moves.
        """
        if self.mistakes:
            raise WiringError(
                f"the real system does not fit its plant: {self}\nMend Reading or Actuation (keys, order, scale, "
                "offset), or the plant. Where all is as it should be, --no-preflight trains without this check."
            )


def check_real_system(
    env: EnvBase,
    plant: Plant,
    closure: nn.Module | None = None,
    *,
    policy: nn.Module | None = None,
    spread: float = 0.2,
    seed: int = 0,
) -> Wiring:
    """Compare one-step predictions of the twin with readings over a few starts, and name what fits better.

    The real system flies ``STARTS`` times ``INTERVALS`` control intervals, with noise on the commands, because what
    does not move shows nothing. The sequence of its episodes then goes on as if nothing had been flown. A reading that
    stands still where the twin moves by more than ``RESOLUTION`` is a mistake, too.

    Args:
        env: the real system, of batch size 1.
        plant: physics of the twin.
        closure: closure of the twin, a first guess; None for one that the plant makes.
        policy: policy or controller that acts; None for commands around the middle of their ranges.
        spread: standard deviation of the noise, as a share of half the range of each action.
        seed: seed of noise and first guess.

    Raises:
        WiringError: if a safety layer refuses every reading.
    """
    generator = torch.Generator(device=env.device).manual_seed(seed)
    closure = plant.make_closure(generator) if closure is None else closure
    return _checked(_fly(env, plant, _Middle(plant) if policy is None else policy, spread, generator), plant, closure)


def check_record(record: Trajectory, plant: Plant, closure: nn.Module) -> Wiring:
    """The same of a flight that has been flown, such as the first one of a training."""
    n = len(record.actions)
    rows = torch.linspace(0, n - 1, min(n, ROWS)).long()
    before = (rows - 1).clamp(min=0)
    t = float(record.start) + plant.dt * rows.double()
    states, actions, exogenous, *_ = record.mapped(lambda values: values.detach().cpu())
    now, earlier = (actions[rows], exogenous[rows]), (actions[before], exogenous[before])
    return _checked(Flown(t, states[rows], *now, states[rows + 1], *earlier), plant, closure)


def _checked(flown: Flown, plant: Plant, closure: nn.Module) -> Wiring:
    plant = copy.deepcopy(plant).cpu()
    fit = _Fit(plant, closure)
    present, (moved, moves) = fit.suspicion("", flown), fit.movement(flown)
    stuck = ~moves & (present.error > RESOLUTION * (1.0 + flown.states.abs().amax(0)))
    names, unknown = (signal.name for signal in plant.states), torch.full_like(moved, torch.nan)
    mistakes = [
        Suspicion(f"the reading of state {name} stands still, and the twin moves", unknown, present.error)
        for name, stands in zip(names, stuck, strict=True)
        if stands
    ]
    if not mistakes and (present.unexplained > EXPLAINED).any():
        mistakes = _better(present, fit, list(_mistakes(plant, flown)))
    return Wiring(plant, present, moved, tuple(mistakes))


def _better(present: Suspicion, fit: "_Fit", mistakes: list[tuple[str, Flown]]) -> list[Suspicion]:
    """The mistakes that fit much better than the wiring as it is, one of a kind."""
    promising = sorted(mistakes, key=lambda mistake: fit.score(mistake[1]))[:FITTED]
    tried = sorted((fit.suspicion(*mistake) for mistake in promising), key=lambda one: one.score)
    limit = min(present.score, tried[0].score + 2.0 * MARGIN) - MARGIN
    kinds: dict[str, Suspicion] = {}
    for mistake in tried:
        if mistake.score < limit:
            kinds.setdefault(mistake.mistake.partition(",")[0], mistake)
    return list(kinds.values())


class _Middle(nn.Module):
    """Commands in the middle of the ranges of the actions."""

    middle: Tensor

    def __init__(self, plant: Plant):
        super().__init__()
        low, high = bounds(plant.actions)
        self.register_buffer("middle", 0.5 * (low + high))

    def forward(self, observation: Tensor) -> Tensor:
        """The middle."""
        return self.middle.expand(*observation.shape[:-1], -1)


@torch.no_grad()
def _fly(env: EnvBase, plant: Plant, policy: nn.Module, spread: float, generator: torch.Generator) -> Flown:
    """The sound intervals of a few short flights."""
    noise = ExplorationConfig(spread=spread, correlation_time=CORRELATION * plant.dt)
    live = LivePolicy(plant, policy, noise, generator=generator).to(env.device)
    rows: list[tuple[Tensor, ...]] = []
    kept = env.state_dict()
    try:
        for _ in range(STARTS):
            row, earlier = env.reset(), None
            live.begin(policy, strength=1.0)
            for k in range(min(INTERVALS, plant.n_steps)):
                row = env.step(row.set("action", live(row["observation"], row["state"], row["exogenous"])))
                after, t = row["next"], row["state"].new_full((1,), k * plant.dt)
                now = after["applied"].clone(), row["exogenous"].clone()
                if not any("refused" in reading and reading["refused"].any() for reading in (row, after)):
                    rows.append((t, row["state"].clone(), *now, after["state"].clone(), *(earlier or now)))
                if after["done"].any():
                    break
                row, earlier = env.step_mdp(row), now
    finally:
        env.load_state_dict(kept)
    if not rows:
        raise WiringError("every reading of the first flights was refused by the safety layer; see its events.")
    return Flown._make([*(torch.cat(parts).cpu() for parts in zip(*rows, strict=True)), 1.0])


def _movement(plant: Plant, flown: Flown) -> Float[Tensor, "n n_s"]:
    return differences(plant.states, flown.ends, flown.states)


class _Fit:
    """One-step predictions of a twin, whose coefficients are fitted to a wiring.

    Args:
        plant: physics of the twin.
        closure: its closure at a first guess.
    """

    def __init__(self, plant: Plant, closure: nn.Module):
        self._plant, self._closure = plant, copy.deepcopy(closure).cpu()
        self._twin = DigitalTwin(plant, self._closure)
        self._weights = [weight for weight in self._closure.parameters() if weight.requires_grad]
        guess = parameters_to_vector(self._weights) if self._weights else torch.zeros(0, dtype=torch.float64)
        self._guess = self._known = guess.detach().clone()  # at first, and after the last fit

    def suspicion(self, mistake: str, flown: Flown) -> Suspicion:
        """A wiring with the coefficients that fit it best."""
        if self._weights:
            self._known = self._fitted(flown)
        return self._suspicion(mistake, flown, self._known)

    def score(self, flown: Flown) -> float:
        """Score of a wiring with the coefficients of the first guess or of the last fit, whichever are better."""
        return min(self._suspicion("", flown, weights).score for weights in (self._guess, self._known))

    def _suspicion(self, mistake: str, flown: Flown, weights: Tensor) -> Suspicion:
        error = self._errors(flown, weights)[0].square().mean(0)
        size, moves = self.movement(flown)
        share = torch.where(moves, (error / size**2).nan_to_num(WORST, WORST).clamp(max=WORST), torch.nan)
        return Suspicion(mistake, share, error.sqrt())

    def movement(self, flown: Flown) -> tuple[Float[Tensor, " n_s"], Bool[Tensor, " n_s"]]:
        """RMS movement of each state, and whether the state moves at all."""
        size = _movement(self._plant, flown).square().mean(0).sqrt()
        return size, size > STILL * (1.0 + flown.states.abs().amax(0))

    def _fitted(self, flown: Flown) -> Tensor:
        from scipy.optimize import least_squares  # here, because it takes a second to load

        size, moves = self.movement(flown)
        latest: dict[str, Tensor] = {}

        def residuals(weights: np.ndarray) -> np.ndarray:
            error, latest["slopes"] = self._errors(flown, torch.as_tensor(weights))
            latest["weights"] = torch.as_tensor(weights).clone()
            error = (error / size)[:, moves].flatten()
            return error.nan_to_num(LARGE, LARGE, -LARGE).clamp(-LARGE, LARGE).numpy()

        def jacobian(weights: np.ndarray) -> np.ndarray:
            if not np.array_equal(latest["weights"].numpy(), weights):
                residuals(weights)
            slopes = -(latest["slopes"] / size[:, None])[:, moves]
            return slopes.flatten(0, 1).nan_to_num(0.0, 0.0, 0.0).numpy()

        best = least_squares(residuals, self._guess.numpy(), jac=jacobian, max_nfev=EVALUATIONS)
        return torch.as_tensor(best.x)

    @torch.no_grad()
    def _errors(self, flown: Flown, weights: Tensor) -> tuple[Float[Tensor, "n n_s"], Float[Tensor, "n n_s n_w"]]:
        """What is read less what is predicted, and the slopes of what is predicted by the coefficients."""
        if self._weights:
            vector_to_parameters(weights, self._weights)
        steps = max(1, round(flown.ratio))
        inputs, actions = (values[:, None].expand(-1, steps, -1) for values in (flown.exogenous, flown.actions))
        try:
            ends, slopes = self._twin.sensitivities(flown.states, inputs, actions, start=flown.t)
        except DivergenceError:
            nan = torch.full_like(flown.ends, torch.nan)
            return nan, nan[..., None].expand(-1, -1, len(weights))
        share = flown.ratio / steps
        movement = share * differences(self._plant.states, ends[:, -1], flown.states)
        error = _movement(self._plant, flown) - movement
        return differences(self._plant.states, error, torch.zeros_like(error)), share * slopes[:, -1]


def _mistakes(plant: Plant, flown: Flown) -> Iterator[tuple[str, Flown]]:
    """Flights as they would be with each mistake mended, and the mistake in words."""
    for what, signals, names in (
        ("state", plant.states, ("states", "ends")),
        ("action", plant.actions, ("actions",)),
        ("input", plant.inputs, ("exogenous",)),
    ):
        for k, signal in enumerate(signals):
            yield f"{what} {signal.name} has the other sign", _changed(flown, names, k, -1.0, 0.0)
            if what == "action" and signal.low != -signal.high:
                mirrored = _changed(flown, names, k, -1.0, signal.low + signal.high)
                yield f"action {signal.name} runs from the other end of its range", mirrored
            for unit, scale, offset in UNITS.get(signal.unit, ()):
                words = f"{what} {signal.name} is in {unit}, where the plant has {signal.unit}"
                yield words, _changed(flown, names, k, scale, offset)
        for k, m in itertools.combinations(range(len(signals)), 2):
            order = list(range(len(signals)))
            order[k], order[m] = m, k
            swapped = {name: getattr(flown, name)[:, order] for name in names}
            yield f"{what}s {signals[k].name} and {signals[m].name} are in the other order", flown._replace(**swapped)
    for ratio in RATIOS:
        yield f"dt is another one, {ratio * plant.dt:g} s and not {plant.dt:g} s", flown._replace(ratio=ratio)
    yield "an action acts one interval late", flown._replace(actions=flown.earlier_actions)
    if plant.inputs:
        yield "an input is read one interval late", flown._replace(exogenous=flown.earlier_exogenous)
    for k, signal in enumerate(plant.actions):
        for level in torch.linspace(signal.low, signal.high, LEVELS).tolist():
            constant = _changed(flown, ("actions",), k, 0.0, level)
            yield f"action {signal.name} does not arrive, a constant one fits", constant


def _changed(flown: Flown, names: tuple[str, ...], column: int, scale: float, offset: float) -> Flown:
    """The flights with one column changed to offset + scale·values."""
    changed = {name: getattr(flown, name).clone() for name in names}
    for values in changed.values():
        values[:, column] = offset + scale * values[:, column]
    return flown._replace(**changed)
