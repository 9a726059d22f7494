"""TorchRL collectors of whole real episodes, one at a time: by steps or, in simulation, by machine code.

TorchRL's own ``Collector`` resets the system as soon as an episode is over, and loses what was flown where the system
fails. A machine begins an episode when the algorithm asks for it, and what it flew before a fault is learned from. The
data are the same.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterator
from typing import cast

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase

from rt_torchrl.plants.plant import Plant, with_memories
from rt_torchrl.programs.contract import ImpureError
from rt_torchrl.systems.environment import PlantEnv, ended_early
from rt_torchrl.systems.exploration import LivePolicy
from rt_torchrl.systems.sound_part import EpisodeEndedError
from rt_torchrl.trajectories.engines.code import require_pure_policy
from rt_torchrl.trajectories.engines.interval import Drive, Interval
from rt_torchrl.trajectories.engines.native import Native
from rt_torchrl.trajectories.rollout import DivergenceError, drive_of, require_finite
from rt_torchrl.trajectories.state_feedback import Remembering, RememberingInterval, StateFeedback


class ExploringInterval(Interval):
    """One control interval of the real system: the sensors, the live policy with its noise, and the plant.

    The drive's command holds the noise of the exploration and the factors of the sensors.

    Args:
        plant: physics of the real system.
        closure: the true closure.
        actor: the live policy with its noise.
        policy: policy that acts, the actor's or one that stands in for it during a part of an episode.
    """

    policy: nn.Module
    low: Tensor
    high: Tensor

    def __init__(self, plant: Plant, closure: nn.Module, actor: LivePolicy, policy: nn.Module):
        super().__init__(plant, closure, policy)
        self.register_buffer("low", actor.low)
        self.register_buffer("high", actor.high)

    def command(self, state: Tensor, drive: Drive) -> Tensor:
        """The command to the actuators at the start of the interval."""
        noise, factor = drive.command.split((len(self.plant.actions), len(self.plant.states)), -1)
        observation = self.plant.observe(drive.t, state * factor, drive.exogenous)
        return (self.policy(observation) + noise).clamp(self.low, self.high)

    def end(self, state: Tensor, command: Tensor, drive: Drive) -> Tensor:
        """The state at the end of the interval, with what was measured at its start in the controller's memories."""
        _, factor = drive.command.split((len(self.plant.actions), len(self.plant.states)), -1)
        end = super().end(state, command, drive)
        return with_memories(self.plant, end, drive.t, state * factor, drive.exogenous)


class ExploringController(RememberingInterval, ExploringInterval):
    """The same interval of a controller with a memory m; its state is (s, m)."""

    def answer(self, carry: Tensor, drive: Drive) -> tuple[Tensor, Tensor]:
        """The command to the actuators and the new memory, with the noise and the factors of the sensors."""
        n_s = len(self.plant.states)
        noise, factor = drive.command.split((len(self.plant.actions), n_s), -1)
        seen = torch.cat([carry[..., :n_s] * factor, carry[..., n_s:]], -1)
        command, memory = super().answer(seen, drive)
        return (command + noise).clamp(self.low, self.high), memory


class EpisodeCollector(BaseCollector):
    """A collector that steps the system: each episode begins with one reset, however the last episode ended.

    Args:
        env: the real system.
        actor: the live policy with its noise.
        plant: plant that gives the length of an episode.
    """

    def __init__(self, env: EnvBase, actor: LivePolicy, plant: Plant):
        super().__init__()
        self.env, self.actor, self._plant = env, actor, plant
        self._acting = TensorDictModule(actor, in_keys=["observation", "state", "exogenous"], out_keys=["action"])

    def iterator(self) -> Iterator[TensorDictBase]:
        """Fly one episode after another."""
        while True:
            yield self.rollout()

    def shutdown(self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True) -> None:
        """Leave the system as it is: it belongs to who made it."""

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        return cast(int, self.env.set_seed(seed, static_seed=static_seed))

    def state_dict(self) -> OrderedDict[str, Tensor]:
        return OrderedDict(self.env.state_dict())

    def load_state_dict(self, state_dict: OrderedDict[str, Tensor]) -> None:
        self.env.load_state_dict(state_dict)

    @torch.no_grad()
    def rollout(self) -> TensorDict:
        """Fly one episode; its TensorDict has the batch size ``batch n``.

        Raises:
            EpisodeEndedError: if the system fails in the episode, or ends it before its horizon where the plant does
                not; it holds the intervals before.
            DivergenceError: if the system is a simulation that diverges.
            ImpureError: if the policy is no function of the observation.
        """
        flown, why = fly(self.env, self._begin, lambda k, row: self._acting(row), self._plant)
        if why is not None:
            raise EpisodeEndedError(why, together(flown))
        return cast(TensorDict, together(flown))

    def _begin(self) -> TensorDictBase:
        first_row = reset(self.env)
        if not isinstance(self.actor.policy, StateFeedback):
            require_pure_policy(self.actor.policy, first_row["observation"])
        return first_row


def fly(
    env: EnvBase,
    begin: Callable[[], TensorDictBase],
    act: Callable[[int, TensorDictBase], TensorDictBase],
    plant: Plant,
) -> tuple[list[TensorDictBase], str | None]:
    """Step a system from its beginning to the end of an episode.

    Args:
        env: the system.
        begin: function that begins the episode and returns what is read first.
        act: function that adds the action to what is read in interval k.
        plant: plant that gives the length of an episode.

    Returns:
        The control intervals, and why the episode has ended before its horizon where the plant does not end it, such as
        an error of the system; None if it has not.

    Raises:
        DivergenceError: if the system is a simulation that diverges.
    """
    flown: list[TensorDictBase] = []
    try:
        row = begin()
    except (DivergenceError, ImpureError):
        raise
    except Exception as error:  # whatever a machine, its driver or its connection may raise
        return flown, failure(error, plant)
    for k in range(plant.n_steps):
        row_with_action = act(k, row)
        try:
            stepped = env.step(row_with_action)
        except DivergenceError:
            raise
        except Exception as error:
            return flown, failure(error, plant, k)
        flown.append(stepped.copy())
        if plant.end_cost is not None and stepped["next", "terminated"].any():
            break
        if stepped["next", "done"].any() and k + 1 < plant.n_steps:
            return flown, str(ended_early(k + 1, plant))
        row = env.step_mdp(stepped)
    return flown, None


def together(flown: list[TensorDictBase]) -> TensorDictBase | None:
    """The intervals of an episode as one TensorDict of batch size ``batch n``; None if there are none."""
    return torch.stack(flown, 1) if flown else None


def failure(error: Exception, plant: Plant, interval: int | None = None) -> str:
    """What a machine, its driver or its connection has raised, in words.

    Args:
        error: what it has raised.
        plant: plant that gives the control interval.
        interval: number of the control interval in the episode; None for a reset.
    """
    where = "in its reset" if interval is None else f"in interval {interval}, at {interval * plant.dt:g} s"
    message = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
    return f"the system failed {where}: {message}"


class FlightCollector(EpisodeCollector):
    """A collector for a :class:`PlantEnv`: the entries and draws of :class:`EpisodeCollector` by machine code.

    No interval takes a Python step. A step of an environment costs some 0.4 ms, and an interval of the engine
    ``native`` about a microsecond; an episode of the drone or the tank has 10 000 intervals. The collector suits
    :class:`PlantEnv` itself and no subclass, because it never calls the step of a subclass. Of :class:`StateFeedback`
    only what is :class:`Remembering` flies by machine code, because none plans.

    Args:
        env: the real system in simulation.
        actor: the live policy with its noise.
    """

    def __init__(self, env: PlantEnv, actor: LivePolicy):
        super().__init__(env, actor, env.plant)
        self._engine = Native()

    @torch.no_grad()
    def rollout(self) -> TensorDict:
        """Fly one episode; its TensorDict has the batch size ``batch n``."""
        env, policy = cast(PlantEnv, self.env), self.actor.policy
        law = policy if isinstance(policy, Remembering) else None
        if isinstance(policy, StateFeedback) and law is None:
            return super().rollout()
        reset(env)
        closure, ((initial_state, exogenous), factor) = env.closure, env.drawn
        n, plant = exogenous.shape[1], env.plant
        noise = torch.stack([self.actor.draw_noise((len(initial_state), len(plant.actions))) for _ in range(n)], 1)
        factors = torch.stack([factor, *(env.sensor_factor() for _ in range(n))], 1)
        drive = drive_of(plant, exogenous, torch.cat([noise, factors[:, :-1]], -1))
        start = initial_state
        if law is not None:
            readings = (start * factors[:, 0])[..., : len(plant.readings)]
            start = torch.cat([start, law.first_memory(readings)], -1)
        kind = ExploringInterval if law is None else ExploringController
        interval = kind(plant, closure, self.actor, policy)
        carries = torch.cat([start.unsqueeze(0), self._engine.end_states(interval, start, drive)])
        states, command = carries[..., : len(plant.states)], interval.command(carries[:-1], drive)
        require_finite(plant, states[1:], initial_state, [closure, policy])
        return flown(plant, states, command, drive, factors.transpose(0, 1)).transpose(0, 1)


def collector_of(env: EnvBase, actor: LivePolicy, plant: Plant) -> EpisodeCollector | FlightCollector:
    """The collector of real episodes: machine code for :class:`PlantEnv` itself, steps for everything else.

    Args:
        env: the real system.
        actor: the live policy with its noise.
        plant: plant that gives the length of an episode.

    Raises:
        ValueError: if the batch size of the system is not 1.
    """
    if env.batch_size != torch.Size([1]):
        raise ValueError(
            f"batch_size={tuple(env.batch_size)} of the real system must be (1,): Reinforcement Twinning learns after "
            "every one episode of one system. Put an environment without a batch into a RealSystem."
        )
    if type(env) is PlantEnv:  # a subclass may override any part of a step
        return FlightCollector(env, actor)
    return EpisodeCollector(env, actor, plant)


MakeCollector = Callable[[EnvBase, LivePolicy, Plant], BaseCollector]
"""Function of the real system, the live policy and the plant that makes a collector, each of whose batches is a whole
episode of batch size ``1 n``."""


def reset(env: EnvBase) -> TensorDictBase:
    """Begin an episode of the algorithm; a simulation, also one behind a safety layer, passes over one draw before."""
    if hasattr(env, "pass_over"):
        env.pass_over()
    return env.reset()


def flown(
    plant: Plant,
    states: Float[Tensor, "samples batch n_s"],
    command: Float[Tensor, "n batch n_a"],
    drive: Drive,
    factors: Tensor,
) -> TensorDict:
    """The entries of an episode, computed from its true states, with the batch size ``n batch``.

    An episode that ends early has only the intervals before its end.
    """
    ends = plant.ended(states[1:]).any(-1)
    n = int(ends.int().argmax()) + 1 if ends.any() else len(command)
    # There is no input after the last interval of the horizon; the last input takes its place.
    exogenous = torch.cat([drive.exogenous, drive.exogenous[-1:]])[: n + 1]
    states, factors, command = states[: n + 1], factors[: n + 1], command[:n]
    drive, over = Drive(*(values[:n] for values in drive)), ends[n - 1]
    applied = plant.actuate(states[:-1], command)
    t = plant.dt * torch.arange(len(states), dtype=torch.float64, device=states.device).unsqueeze(-1)
    measured = states * factors
    reward = -plant.running_cost(drive.t, measured[:-1], applied, drive.exogenous)
    reward[-1] -= plant.terminal_cost(states[-1]) / plant.dt
    entries = {"state": measured[..., : len(plant.readings)], "exogenous": exogenous}
    entries["observation"] = plant.observe(t, measured, exogenous)
    entries["applied"] = torch.cat([torch.zeros_like(applied[:1]), applied])
    flags = {
        key: torch.zeros(*reward.shape, 1, dtype=torch.bool, device=states.device)
        for key in ("done", "truncated", "terminated")
    }
    final = {key: never.clone() for key, never in flags.items()} | {"reward": reward.unsqueeze(-1)}
    final["done"][-1], final["truncated"][-1], final["terminated"][-1] = True, ~over, over
    return TensorDict(
        {key: value[:-1] for key, value in entries.items()}
        | flags
        | {"action": command, "next": {key: value[1:] for key, value in entries.items()} | final},
        batch_size=reward.shape,
        device=states.device,
    )
