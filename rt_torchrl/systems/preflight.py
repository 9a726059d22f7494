r"""The check of a real system's wiring before a training: one-step predictions of the twin beside readings.

Each interval of a short flight gives a state s, an action a, an input z and the state after it. The twin predicts that
state, :math:`\hat s_{k+1} = \Phi(s_k, a_k, z_k)`, and what it leaves unexplained of the movement of state i is

.. math:: q_i = \frac{\sum_k (s_{k+1} - \hat s_{k+1})_i^2}{\sum_k (s_{k+1} - s_k)_i^2}

The coefficients of the closure are fitted first, so that ordinary model error counts as little as it can. If too much
is left, the same is done for every mistake of a list. One that leaves much less, :math:`\sum_i \log q_i` lower by
``MARGIN``, is named. Where sensors have noise, the same is done of predictions over more intervals: noise stays as
large as it is, while the movement grows. A large share that no mistake explains is a warning and no refusal, because
noise of sensors and dynamics that the twin lacks leave up to all of the movement unexplained, too.
"""

import copy
import itertools
import math
import re
import warnings
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase

from rt_torchrl.optimisers.levenberg_marquardt import place
from rt_torchrl.options import OTHER_UNITS
from rt_torchrl.plants.plant import Plant, require_end_cost
from rt_torchrl.plants.policies import SaturatedAffine
from rt_torchrl.plants.shapes import Inputs
from rt_torchrl.plants.signal import Signal, differences
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy
from rt_torchrl.systems.sound_part import sound_part
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import Sensitivities

STARTS, INTERVALS = 3, 40
"""Number of starts, and of control intervals after each."""
ROWS = 200
"""Greatest number of windows of a record that are looked at."""
EXPLAINED = 3e-3
"""Share of the movement of a state that a twin with fitted coefficients may leave unexplained without a question."""
DOUBTFUL = 0.2
"""Share of the movement of a state beyond which a warning names the state."""
DRAWS, BEYOND = 10, 3.0
"""Drawn courses of the inputs that readings are compared with, and the factor by which readings may leave them."""
FLOOR = 3e-4
"""Share below which a prediction counts as exact, whatever the digits of sensors and integrators."""
MARGIN = math.log(8.0)
"""Least gain of a mistake that is named, and by how much it must be ahead of others to be named alone."""
LENGTHS, ALTERNATING = (4, 20), 2.0
"""Numbers of control intervals of further predictions where sensors have noise, which hides in one interval what shows
over many; and how many standard errors the correlation of the errors of neighbouring intervals is below zero where
they are noise: that of white noise is −a/(1 + a²), if a state depends on the one before by the factor a."""
WORSE = 1.02
"""Share of a state that a mistake may leave, over that which the present wiring leaves."""
LARGE, WORST = 1e3, 1e6
"""Error, in movements, and share that stand for a prediction that is not finite."""
EVALUATIONS, QUICK = 12, 4
"""Greatest number of evaluations in a fit of the coefficients, and in the first one of each mistake."""
LIKELY, FITTED = 60, 12
"""Number of mistakes, the best ones after their first fit, that are tried over more intervals, and to which the
coefficients are fitted: twenty states may be wired wrongly in five hundred ways."""
EARLY = 6
"""First intervals of a flight that are looked at alone: feedback through a mistake may drive the system into a stop."""
RATIOS = (0.1, 0.2, 0.25, 0.4, 0.5, 2.0, 2.5, 4.0, 5.0, 10.0)
"""Ratios of the real control interval to the plant's that are tried."""
CORRELATION = 3.0
"""Correlation time of the noise, in control intervals: noise that is new in each one hardly moves a slow plant."""
STILL, RESOLUTION = 1e-9, 1e-3
"""Movement or error of a state, as a share of its size: below the first it is none, and beyond the second it shows."""
FACTORS = (1e-3, 1e-2, 1e-1, 1e1, 1e2, 1e3)
"""Factors that are tried for each state and input, and for all states of a unit together, beside ``OTHER_UNITS``."""
LEVELS, LASTING = 5, 1e-3
"""Number of constant actions over the range of each that are tried, and the share of the horizon that noise must last.

A slow actuator filters away what is shorter, as if no action arrived.
"""


class WiringError(ValueError):
    """The real system does not fit its plant: a reading or a command is wired wrongly."""


class Flown(NamedTuple):
    """Control intervals of short flights, as they were read or as a mistake would have them; ``n`` rows each.

    The earlier actions are those of the interval before; ``ratio`` is the real control interval by the plant's, and
    ``signs`` are those of the equations of the states.
    """

    t: Float[Tensor, " n"]
    states: Float[Tensor, "n n_s"]
    actions: Float[Tensor, "n length n_a"]
    exogenous: Float[Tensor, "n length n_z"]
    ends: Float[Tensor, "n n_s"]
    earlier_actions: Float[Tensor, "n length n_a"]
    ratio: float = 1.0
    signs: Float[Tensor, " n_s"] | float = 1.0


class Unexplained(NamedTuple):
    """The share of each state's movement that predictions leave unexplained, and their RMS error in its unit.

    ``noise`` says where the errors of neighbouring intervals alternate, as those by noise of a sensor do.
    """

    share: Float[Tensor, " n_s"]
    error: Float[Tensor, " n_s"]
    noise: Bool[Tensor, " n_s"]

    @property
    def score(self) -> float:
        r""":math:`\sum_i \log q_i`, of the states that move."""
        return float(self.share[self.share.isfinite()].clamp(FLOOR, WORST).log().sum())


class Wiring(NamedTuple):
    """What the check has found.

    Args:
        plant: plant that gives the states.
        moved: RMS movement of each state in an interval, in its unit.
        present: what the wiring as it is leaves unexplained.
        noise: whether what is left of a state is noise of its sensor.
        mistakes: the readings that are wrong by themselves, of which no other wiring is tried: a state that stands
            still where the twin moves, two signals with the same readings, an input far outside its draws; or the
            mistakes that fit much better, the best one first. Empty if the wiring is right or nothing fits.
        doubts: where no mistake is named, states of whose movement much is unexplained or whose starts are strange, and
            inputs that never change although draws do, in words.
    """

    plant: Plant
    moved: Float[Tensor, " n_s"]
    present: Unexplained
    noise: Bool[Tensor, " n_s"]
    mistakes: tuple[str, ...]
    doubts: tuple[str, ...]

    def __str__(self) -> str:
        rows = [f"one step of {self.plant.dt:g} s of plant {self.plant.name!r} beside the readings:"]
        rows += [f"  mistake: {mistake}" for mistake in self.mistakes] or ["  no mistake explains the readings better"]
        rows += [f"  {doubt}" for doubt in self.doubts]
        columns = (self.moved, self.present.share, self.present.error, self.noise)
        for signal, moved, share, error, noise in zip(self.plant.states, *columns, strict=True):
            explained = f"{100.0 * share:.3g} % unexplained" if share.isfinite() else "it does not move"
            explained += ", which is noise of its sensor" if noise else ""
            rows.append(
                f"  {signal.name}: moves by {moved:.4g} {signal.unit}, predicted within {error:.4g}; {explained}"
            )
        return "\n".join(rows)

    def require(self) -> None:
        """Refuse a system whose wiring does not fit, and warn of its doubts.

        Raises:
            WiringError: if there are mistakes.
        """
        if self.mistakes:
            raise WiringError(
                f"the real system does not fit its plant: {self}\nMend Reading or Actuation (keys, order, scale, "
                "offset), or the plant. Where all is as it should be, --no-preflight trains without this check."
            )
        for doubt in self.doubts:
            warnings.warn(doubt, stacklevel=2)


@torch.no_grad()
def check_real_system(
    env: EnvBase,
    plant: Plant,
    closure: nn.Module | None = None,
    *,
    policy: nn.Module | None = None,
    spread: float = 0.2,
) -> Wiring:
    """Compare one-step predictions of the twin with readings over a few starts, and name what fits better.

    The real system flies ``STARTS`` times ``INTERVALS`` control intervals, with noise on the commands, because what
    does not move shows nothing. The sequence of its episodes then goes on as if nothing had been flown. A reading that
    stands still where the twin moves by more than ``RESOLUTION`` is a mistake, too, as are two signals with the same
    readings, and an input far outside what ``plant.draw_exogenous`` draws. One that never changes, where the draws do,
    is a doubt.

    Args:
        env: the real system, of batch size 1.
        plant: physics of the twin.
        closure: closure of the twin, a first guess; None for one that the plant makes.
        policy: policy or controller that acts; None for commands around the middle of their ranges.
        spread: standard deviation of the noise, as a share of half the range of each action.

    Raises:
        WiringError: if a safety layer refuses every reading.
    """
    generator, other = (torch.Generator(device=env.device).manual_seed(0) for _ in range(2))
    closure = plant.make_closure(generator) if closure is None else closure
    if policy is None:
        policy = SaturatedAffine(len(plant.observations), plant.actions, weight_scale=0.0, generator=other)
    noise = ExplorationConfig(spread=spread, correlation_time=CORRELATION * plant.dt)
    live = LivePolicy(plant, policy, noise, generator=generator).to(env.device)
    act = TensorDictModule(live, in_keys=["observation", "state", "exogenous"], out_keys=["action"])
    parts: list[Trajectory] = []
    kept = env.state_dict()
    try:
        for _ in range(STARTS):
            live.begin(policy, strength=1.0)
            episode = env.rollout(min(INTERVALS, plant.n_steps), act)[0].cpu()
            for first, last in sound_part(episode, plant, None).parts:
                part = episode[first:last]
                states = torch.cat([part["state"], part["next", "state"][-1:]])
                parts.append(Trajectory(states, part["next", "applied"], part["exogenous"], first * plant.dt))
    finally:
        env.load_state_dict(kept)
    if not parts:
        raise WiringError("every reading of the first flights was refused by the safety layer; see its events.")
    return check_records(parts, plant, closure)


def _windows(records: Sequence[Trajectory], plant: Plant, length: int) -> Flown:
    """Windows of so many control intervals of records: ``ROWS`` of each, if it has them, and all of the first ones.

    None begins before the middle of the one before.
    """
    parts = []
    for record in records:
        n = len(record.actions) - length + 1
        if n > 0:
            count = min(ROWS, -(-n // max(1, length // 2)))
            rows = torch.cat([torch.arange(min(n, EARLY)), torch.linspace(0, n - 1, count).long()]).unique()
            t, each = float(record.start) + plant.dt * rows.double(), rows[:, None] + torch.arange(length)
            states, actions, exogenous, *_ = record.mapped(lambda values: values.detach().cpu())
            ends, earlier = states[rows + length], actions[(each - 1).clamp(min=0)]
            parts.append((t, states[rows], actions[each], exogenous[each], ends, earlier))
    t, states, actions, exogenous, ends, earlier = (torch.cat(column) for column in zip(*parts, strict=True))
    return Flown(t, states, actions, exogenous, ends, earlier)


def check_records(records: Sequence[Trajectory], plant: Plant, closure: nn.Module) -> Wiring:
    """The same of flights that have been flown, such as the first one of a training."""
    fit, flown = _Fit(copy.deepcopy(plant).cpu(), closure), _windows(records, plant, 1)
    present, (moved, moves) = fit.unexplained(flown), fit.movement(flown)
    inputs = plant.draw_exogenous(DRAWS, torch.Generator().manual_seed(0))
    explained, noise, share = not (present.share > EXPLAINED).any(), torch.zeros_like(moves), present.share
    stuck = ~moves & (present.error > RESOLUTION * (1.0 + flown.states.abs().amax(0)))
    mistakes = [
        f"the reading of state {signal.name} stands still, and the twin moves"
        for signal, stands in zip(plant.states, stuck, strict=True)
        if stands
    ]
    mistakes += [*_same_readings(plant, flown, explained), *_strange_inputs(plant, inputs, flown)]
    if not mistakes and not explained:
        early = flown.t < (EARLY - 0.5) * plant.dt
        first = flown._replace(**{name: getattr(flown, name)[early] for name in Flown._fields[:6]})
        noise = fit.unexplained(_windows([record.part(0, ROWS, plant.dt) for record in records], plant, 1)).noise
        likely: list[str] = []
        # More coefficients than readings would explain anything, and noise leaves nothing that is explained wholly.
        if first.ends.numel() > len(fit.guess) and not noise.any():
            mistakes, _ = _better(fit, first, fit.unexplained(first), wholly=True)
        if not mistakes:
            mistakes, likely = _better(fit, flown, present)
        for length in LENGTHS if noise.any() else ():
            if not mistakes and 2 * length <= max(len(record.actions) for record in records):
                windows = _windows(records, plant, length)
                left = fit.unexplained(windows)
                mistakes, _ = _better(fit, windows, left, among=likely)
                share = left.share
    doubts = [] if mistakes else _doubts(plant, inputs, torch.where(noise, 0.0, share), flown)
    return Wiring(plant, moved, present, noise, tuple(mistakes), tuple(doubts))


def _doubts(plant: Plant, inputs: Inputs, share: Float[Tensor, " n_s"], flown: Flown) -> Iterator[str]:
    """What no mistake explains and may be right all the same."""
    shares = zip(plant.states, share.tolist(), strict=True)
    if much := [f"{100.0 * share:.3g} % of {signal.name}" for signal, share in shares if share > DOUBTFUL]:
        yield (
            f"the twin leaves {', '.join(much)} unexplained, which is no white noise of a sensor: dynamics that the "
            "twin lacks, such as a stop or noise that drives it, an angle that jumps by a turn (periodic=True), or a "
            "mistake in a Reading, an Actuation or the plant's equations"
        )
    drawn = plant.draw_initial_state(STARTS * DRAWS, torch.Generator().manual_seed(0))
    for signal, draws, read in zip(plant.states, drawn.T, flown.states[flown.t == 0.0].T, strict=True):
        if len(read) and _outside(draws, read, widths=0.5):
            scales = _other_scales(signal.unit, FACTORS)
            fits = (f"{words}, " for words, a, b in scales if not _outside(draws, b + a * read, widths=0.5))
            yield (
                f"state {signal.name} is read at the start {_beside(signal, read, draws)}: {next(fits, '')}a wrong "
                "zero, or other starts than those that plans are made for"
            )
    seen, starts = 1 + round(float(flown.t.max()) / plant.dt), int((flown.t == 0.0).sum())
    for signal, course, read in zip(plant.inputs, inputs[:, :seen].unbind(-1), flown.exogenous.unbind(-1), strict=True):
        changes, differs = (course != course[:, :1]).any(-1).all(), len(course.unique(dim=0)) == DRAWS
        if (read == read.flatten()[0]).all() and (changes or (differs and starts > 1)):
            yield (
                f"input {signal.name} is always read as {read.max():.4g} {signal.unit}, where "
                f"{'every draw' if changes else 'one draw after the other'} of the plant changes: a wrong Reading, or "
                "draws that are none of the real system's"
            )


def _same_readings(plant: Plant, flown: Flown, explained: bool) -> Iterator[str]:
    """Which states have the readings of an input, or of another state if the twin does not move as they do."""
    signals = [f"state {signal.name}" for signal in plant.states] + [f"input {signal.name}" for signal in plant.inputs]
    readings = torch.cat([flown.states, flown.exogenous[:, 0]], -1)
    for k, m in itertools.combinations(range(len(signals)), 2):
        alike = torch.equal(readings[:, k], readings[:, m]) and bool((readings[:, k] != readings[0, k]).any())
        if alike and k < len(plant.states) and not (explained and m < len(plant.states)):
            yield f"{signals[k]} and {signals[m]} have the same readings"


def _strange_inputs(plant: Plant, drawn: Inputs, flown: Flown) -> Iterator[str]:
    """Which inputs are read far outside what the plant draws, or at a small share of it."""
    for signal, course, read in zip(plant.inputs, drawn.unbind(-1), flown.exogenous.unbind(-1), strict=True):
        if _outside(course, read, widths=BEYOND - 1.0) or BEYOND * read.abs().max() < course.abs().min():
            yield f"input {signal.name} is read {_beside(signal, read, course)}"


def _beside(signal: Signal, read: Tensor, drawn: Tensor) -> str:
    """Readings beside draws in words."""
    low, high = drawn.min(), drawn.max()
    return f"between {read.min():.4g} and {read.max():.4g} {signal.unit}, where the plant draws {low:.4g} to {high:.4g}"


def _outside(course: Tensor, read: Tensor, *, widths: float) -> bool:
    """Whether readings lie beyond what is drawn by more than so many of its widths."""
    low, high = course.min().item(), course.max().item()
    width = high - low or max(abs(low), abs(high))
    return width > 0.0 and max(low - read.min().item(), read.max().item() - high) > widths * width


def _better(
    fit: "_Fit", flown: Flown, present: Unexplained, *, wholly: bool = False, among: Sequence[str] = ()
) -> tuple[list[str], list[str]]:
    """The mistakes, among all or some, that leave much less than the wiring at present, one of a kind; and likely ones.

    A mistake in the reading of a state must leave at most half of that state, and others hardly more of any state than
    the present wiring. Where no error of the present wiring shows beside the size of its state, or with ``wholly``, a
    mistake must explain all movement.
    """
    if not (present.share > EXPLAINED).any():
        return [], []
    shows = (present.error > RESOLUTION * (1.0 + flown.states.abs().amax(0))).any() and not wholly
    enough = torch.where(present.share > 2.0 * EXPLAINED, 0.5 * present.share, EXPLAINED)
    tried, mistakes = [], [pair for pair in _mistakes(fit.plant, flown) if not among or pair[0] in among]
    ranked = sorted(mistakes, key=lambda pair: fit.unexplained(pair[1], QUICK).score)
    for words, mended in ranked[:FITTED]:
        left = fit.unexplained(mended)
        changed = (mended.states != flown.states).any(0)
        limit = torch.where(changed, enough, WORSE * present.share + EXPLAINED) if shows else EXPLAINED
        if not (left.share > limit).any():
            tried.append((left.score, words))
    tried.sort(key=lambda pair: pair[0])
    kinds: dict[str, str] = {}
    for score, words in tried:
        if score < min(present.score, tried[0][0] + 2.0 * MARGIN) - MARGIN:
            kinds.setdefault(re.split(",| (?:is|are) in ", words)[0], words)
    return list(kinds.values()), [words for words, _ in ranked[:LIKELY]]


class _Fit:
    """One-step predictions of a twin, whose coefficients are fitted to a wiring.

    Args:
        plant: physics of the twin.
        closure: its closure at a first guess.
    """

    def __init__(self, plant: Plant, closure: nn.Module):
        require_end_cost(plant)
        self.plant, self._closure = plant, copy.deepcopy(closure).cpu()
        # A twin takes recorded actions as they are; what a mistake made of a command goes through actuators.
        self._sensitivities = Sensitivities(plant, self._closure)
        self._weights = [weight for weight in self._closure.parameters() if weight.requires_grad]
        self.guess = torch.cat([torch.zeros(0).double(), *(weight.detach().flatten() for weight in self._weights)])

    def unexplained(self, flown: Flown, evaluations: int = EVALUATIONS) -> Unexplained:
        """What is left with the coefficients that fit best after so many evaluations."""
        errors, _ = self._errors(flown, self._fitted(flown, evaluations) if self._weights else self.guess)
        error, (size, moves) = errors.square().mean(0), self.movement(flown)
        share = torch.where(moves, (error / size**2).nan_to_num(WORST, WORST).clamp(max=WORST), torch.nan)
        neighbours = (flown.t.diff() - self.plant.dt).abs() < 0.5 * self.plant.dt
        alike = (errors[1:] * errors[:-1])[neighbours].mean(0) / error
        beyond = -ALTERNATING / max(1, int(neighbours.sum())) ** 0.5
        return Unexplained(share, error.sqrt(), (share > EXPLAINED) & (alike < beyond))

    def movement(self, flown: Flown) -> tuple[Float[Tensor, " n_s"], Bool[Tensor, " n_s"]]:
        """RMS movement of each state, and whether the state moves at all."""
        size = differences(self.plant.states, flown.ends, flown.states).square().mean(0).sqrt()
        return size, size > STILL * (1.0 + flown.states.abs().amax(0))

    def _fitted(self, flown: Flown, evaluations: int) -> Tensor:
        from scipy.optimize import least_squares  # here, because it takes a second to load

        size, moves = self.movement(flown)
        slopes: dict[bytes, Tensor] = {}

        def residuals(weights: np.ndarray) -> np.ndarray:
            error, slopes[weights.tobytes()] = self._errors(flown, torch.as_tensor(weights))
            error = (error / size)[:, moves].flatten()
            return error.nan_to_num(LARGE, LARGE, -LARGE).clamp(-LARGE, LARGE).numpy()

        def jacobian(weights: np.ndarray) -> np.ndarray:
            change = -(slopes[weights.tobytes()] / size[:, None])[:, moves]
            return change.flatten(0, 1).nan_to_num(0.0, 0.0, 0.0).numpy()

        with np.errstate(all="ignore"):  # of a mistake under which the twin explodes
            best = least_squares(residuals, self.guess.numpy(), jac=jacobian, max_nfev=evaluations)
        return torch.as_tensor(best.x)

    @torch.no_grad()
    def _errors(self, flown: Flown, weights: Tensor) -> tuple[Float[Tensor, "n n_s"], Float[Tensor, "n n_s n_w"]]:
        """What is read less what is predicted, and the slopes of what is predicted by the coefficients."""
        if self._weights:
            place(weights, self._weights)
        duration = flown.ratio * flown.actions.shape[1]
        steps = max(1, round(duration))
        held = (torch.arange(steps) / flown.ratio).long()
        inputs, actions = flown.exogenous[:, held], flown.actions[:, held]
        try:
            ends, slopes = self._sensitivities(flown.states, inputs, actions, start=flown.t)
        except DivergenceError:
            nan = torch.full_like(flown.ends, torch.nan)
            return nan, nan[..., None].expand(-1, -1, len(weights))
        share = flown.signs * torch.full((flown.states.shape[-1],), duration / steps, dtype=torch.float64)
        movement = share * differences(self.plant.states, ends[:, -1], flown.states)
        error = differences(self.plant.states, flown.ends - flown.states, movement)
        return error, share[:, None] * slopes[:, -1]


def _mistakes(plant: Plant, flown: Flown) -> Iterator[tuple[str, Flown]]:
    """Mistakes in words, and the flights as they would be with each one mended."""
    yield from _signal_mistakes("state", plant.states, flown, ("states", "ends"), FACTORS)
    yield from _signal_mistakes("action", plant.actions, flown, ("actions",), ())
    yield from _signal_mistakes("input", plant.inputs, flown, ("exogenous",), FACTORS)
    for unit in ("rad", "deg"):
        (other, scale, _), *_ = OTHER_UNITS[unit]
        columns = [k for k, signal in enumerate(plant.states) if signal.unit in (unit, f"{unit}/s")]
        if len({plant.states[k].unit for k in columns}) == 2:
            turned = _changed(flown, ("states", "ends"), columns, scale, 0.0)
            yield f"all states in {unit} and {unit}/s are in {other} and {other}/s", turned
    for signal, signs in zip(plant.states, 1.0 - 2.0 * torch.eye(len(plant.states)).double(), strict=True):
        yield f"the equation of state {signal.name} is negated", flown._replace(signs=signs)
    for ratio in RATIOS:
        yield f"dt is another one, {ratio * plant.dt:g} s and not {plant.dt:g} s", flown._replace(ratio=ratio)
    yield "an action acts one interval late", flown._replace(actions=flown.earlier_actions)
    for k, signal in enumerate(plant.actions):
        if signal.low != -signal.high:
            mirrored = _changed(flown, ("actions",), [k], -1.0, signal.low + signal.high)
            yield f"action {signal.name} runs from the other end of its range", mirrored
        levels = LEVELS if LASTING * plant.n_steps <= CORRELATION else 0
        for level in torch.linspace(signal.low, signal.high, levels).tolist():
            constant = _changed(flown, ("actions",), [k], 0.0, level)
            yield f"action {signal.name} does not arrive, a constant one fits", constant


def _signal_mistakes(
    what: str, signals: Sequence[Signal], flown: Flown, names: tuple[str, ...], factors: Sequence[float]
) -> Iterator[tuple[str, Flown]]:
    """The signs, units and orders of signals, whose values the flights hold under the names.

    All signals of a unit may have one mistake together.
    """
    groups = [(f"{what} {signal.name} is", signal.unit, [k]) for k, signal in enumerate(signals)]
    units = [signal.unit for signal in signals]
    for unit in dict.fromkeys(units):
        columns = [k for k, other in enumerate(units) if other == unit]
        groups += [(f"all {what}s in {unit} are", unit, columns)] if len(columns) > 1 else []
    for subject, unit, columns in groups:
        yield f"{subject} negated", _changed(flown, names, columns, -1.0, 0.0)
        for words, scale, offset in _other_scales(unit, factors):
            yield f"{subject} {words}", _changed(flown, names, columns, scale, offset)
    for k, m in itertools.combinations(range(len(signals)), 2):
        order = list(range(len(signals)))
        order[k], order[m] = m, k
        swapped = {name: getattr(flown, name)[..., order] for name in names}
        yield f"{what}s {signals[k].name} and {signals[m].name} are in the other order", flown._replace(**swapped)


def _other_scales(unit: str, factors: Sequence[float]) -> Iterator[tuple[str, float, float]]:
    """Other units of a signal and factors that are none of these in words, with scale and offset that mend them."""
    others = OTHER_UNITS.get(unit, ())
    for other, scale, offset in others:
        yield f"in {other}, where the plant has {unit}", scale, offset
    for factor in factors:
        if all(not 0.5 < factor / scale < 2.0 for _, scale, _ in others):
            yield f"read {1.0 / factor:g} times as large as it is", factor, 0.0


def _changed(flown: Flown, names: tuple[str, ...], columns: list[int], scale: float, offset: float) -> Flown:
    """The flights with some columns changed to offset + scale·values."""
    changed = {name: getattr(flown, name).clone() for name in names}
    for values in changed.values():
        values[..., columns] = offset + scale * values[..., columns]
    return flown._replace(**changed)
