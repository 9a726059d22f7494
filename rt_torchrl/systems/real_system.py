"""A real system that is not a plant in simulation: any TorchRL or Gymnasium environment in a plant's terms."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, GymWrapper

from rt_torchrl.export.c_controller import Controller
from rt_torchrl.options import array_of
from rt_torchrl.plants.plant import Plant, replaying
from rt_torchrl.plants.signal import Signal
from rt_torchrl.systems.environment import AroundSystem, at_end, at_start, declare_specs, ended_early, layers


def joined(*entries: Tensor) -> Tensor:
    """The entries joined into one vector, one behind the other."""
    return torch.cat(entries, -1)


@dataclass(frozen=True, kw_only=True)
class Reading:
    """The place of a plant's vector in an environment's report; the vector is offset + scale·of(entries).

    Args:
        keys: entries of the environment's TensorDict that are read.
        of: function that makes the vector of these entries. It takes them in the order of ``keys``, in double
            precision, with the features last; by default it joins them. For an angle whose sine and cosine are
            reported, it is an arc tangent.
        scale: one unit of the vector in the plant's units: a number for all signals, or one for each signal.
        offset: value in the plant's units where the vector is zero: a number for all signals, or one for each signal.

    Raises:
        ValueError: if a number of ``scale`` or ``offset`` is not finite.
    """

    keys: tuple[NestedKey, ...] = ("observation",)
    of: Callable[..., Tensor] = joined
    scale: float | Sequence[float] = 1.0
    offset: float | Sequence[float] = 0.0

    def __post_init__(self) -> None:
        require_numbers("reading", scale=self.scale, offset=self.offset)

    def read(
        self, reported: TensorDictBase, signals: tuple[Signal, ...], what: str, *, finite: bool = True
    ) -> Float[Tensor, "1 n"]:
        """The vector in the plant's units.

        Args:
            reported: report of the environment.
            signals: signals of the vector.
            what: name of the vector in errors.
            finite: whether it must be finite.

        Raises:
            ValueError: if an entry is missing or a tuple, or the vector does not have the shape of the signals, or is
                not finite.
        """
        names = [signal.name for signal in signals]
        if wrong := [key for key in self.keys if not isinstance(reported.get(key, None), Tensor)]:
            known = sorted(map(str, reported.keys(include_nested=True, leaves_only=True)))
            raise ValueError(
                f"{what} is read from {wrong}, which the environment does not report as an array; it has {known}. A "
                "tuple is flattened first, such as by GymWrapper(gymnasium.wrappers.FlattenObservation(env))."
            )
        vector = self.of(*(reported.get(key).double() for key in self.keys))
        if tuple(vector.shape) != (*reported.batch_size, len(signals)):
            raise ValueError(
                f"{what}, read from {list(self.keys)}, has shape {tuple(vector.shape)}; the plant needs "
                f"{(*reported.batch_size, len(signals))}, which is {names}: give the reading a function `of` them."
            )
        vector = in_units(vector, self.scale, self.offset).reshape(1, len(signals))
        if finite and not vector.isfinite().all():
            raise ValueError(f"{what} {names}, read from {list(self.keys)}, is not finite: {vector[0].tolist()}.")
        return vector


@dataclass(frozen=True, kw_only=True)
class Actuation:
    """The place where an environment takes its action; the plant's command is offset + scale·action.

    Args:
        key: entry of the environment's TensorDict that takes the action.
        scale: one unit of the environment's action in the plant's units: a number for all actions, or one for each.
        offset: command of the plant where the environment's action is zero: a number for all actions, or one for each.

    Raises:
        ValueError: if a number of ``scale`` or ``offset`` is not finite, or a scale is zero.
    """

    key: NestedKey = "action"
    scale: float | Sequence[float] = 1.0
    offset: float | Sequence[float] = 0.0

    def __post_init__(self) -> None:
        require_numbers("actuation", scale=self.scale, offset=self.offset)
        if not (np.asarray(self.scale) != 0.0).all():
            raise ValueError(f"scale={self.scale} of the actuation must not be zero.")

    def action(self, command: Float[Tensor, " n_a"]) -> Float[Tensor, " n_a"]:
        """The environment's action for a command in the plant's units."""
        scale, offset = (torch.as_tensor(x, dtype=torch.float64).to(command) for x in (self.scale, self.offset))
        return (command - offset) / scale


def require_numbers(what: str, **values: float | Sequence[float]) -> None:
    """Refuse arguments that are NaN or infinite.

    Args:
        what: object that has these arguments, as the error calls it.
        values: arguments by name.

    Raises:
        ValueError: if an argument is not finite; it names the first one.
    """
    for argument, value in values.items():
        numbers = array_of(argument, value)
        # A plant may have no inputs, but a reading has numbers.
        if not np.isfinite(numbers).all() or (numbers.size == 0 and argument != "exogenous"):
            raise ValueError(f"{argument}={value} of the {what} must be finite: a number, or one for each signal.")


def in_units(values: Tensor, scale: float | Sequence[float], offset: float | Sequence[float]) -> Tensor:
    """offset + scale·values, in double precision."""
    double = partial(torch.as_tensor, dtype=torch.float64, device=values.device)
    return double(offset) + double(scale) * values


def episode_seed(seed: int, number: int) -> int:
    """Seed of one episode of a real system.

    Args:
        seed: seed of the whole sequence of episodes.
        number: number of the episode in that sequence, from 0.
    """
    return int(np.random.SeedSequence((seed, number)).generate_state(1)[0] >> 1)


class RealSystem(EnvBase):
    """An environment that somebody else wrote, with the entries of a :class:`PlantEnv`.

    State and exogenous input are read from the environment's report. Observation and reward are the plant's own
    functions of them, and so mean the same on the real system and on its twin; the environment's own reward is not
    used. An episode is as long as the plant's and takes one reset, at its beginning. It ends early in a state in which
    the plant says so (:meth:`Plant.ended`), whether or not the environment ends it there; if the plant may end at all,
    it also ends where the environment terminates it, because a reading with noise may not show the end. The environment
    must not end an episode elsewhere, neither by a time limit nor by a terminal state of its own.

    Args:
        env: TorchRL environment of one system, with batch size () or (1,); a Gymnasium environment goes into TorchRL's
            ``GymWrapper`` first.
        plant: physics and control problem of the twin; its draws are not used here.
        state: place of the plant's state in the environment's report.
        exogenous: place of the exogenous input of the coming interval in the environment's report; or a constant for
            each input; or None for a plant without inputs.
        actuation: place of the command in the environment.
        applied: place of the applied action in the report at the end of an interval; with None, ``plant.actuate``
            tells what was applied.
        closure: the true closure, on which policies are then judged in simulation; None where it is not known.
        computes: whether the :attr:`Plant.controller_states`, which the environment does not report, are computed here,
            as an exported controller computes them; ``state`` then reads the other ones.
        seed: seed of the sequence of episodes. Each episode has a seed of its own, made of this one and the episode's
            number, so that a training can be resumed. None for a system that takes no seed.
        device: device of the entries.

    Raises:
        ValueError: if ``env`` is not a TorchRL environment or is a batch of systems, an entry is missing or misshapen,
            a constant input is not finite, the plant has states that no sensor reads, the environment's range of an
            action does not contain the plant's, or its time limit is shorter than the plant's horizon; in a step, if an
            entry that is read is not reported, or the environment ends the episode where the plant does not.
    """

    observation_spec: Composite

    def __init__(
        self,
        env: EnvBase,
        plant: Plant,
        *,
        state: Reading,
        exogenous: Reading | Sequence[float] | None = None,
        actuation: Actuation | None = None,
        applied: Reading | None = None,
        closure: nn.Module | None = None,
        computes: bool = False,
        seed: int | None = 0,
        device: torch.device | str = "cpu",
    ):
        if not isinstance(env, EnvBase):
            raise ValueError(f"env is a {type(env).__name__}; wrap it first, such as torchrl.envs.GymWrapper(env).")
        if env.batch_size not in (torch.Size([]), torch.Size([1])):
            raise ValueError(f"batch_size={tuple(env.batch_size)} of the environment must be () or (1,): one system.")
        if plant.unread:
            hidden = ", ".join(state.name for state in plant.states[-plant.unread :])
            raise ValueError(f"no sensor reads {hidden} of plant {plant.name!r}; give a plant without extensions.")
        super().__init__(device=torch.device(device), batch_size=torch.Size([1]))
        self.env, self.plant, self.closure = env, plant.to(device), closure
        self._state, self._applied, self._actuation = state, applied, actuation or Actuation()
        self._exogenous = () if exogenous is None else exogenous
        # It advances under what was applied, which may be another action than the plant's actuators would let pass.
        self._controller = Controller(replaying(plant), nn.Identity()) if computes else None
        self._read = plant.states
        if self._controller is not None:
            self._read = tuple(plant.states[k] for k in self._controller.measured)
        if not isinstance(self._exogenous, Reading):
            require_numbers("real system", exogenous=self._exogenous)
        self._seed, self._episodes = seed, 0
        self._judged = isinstance(env.full_observation_spec.get("refused", None), Binary)  # by a safety layer
        declare_specs(self, plant, refused=self._judged)
        self._require_fit()

    def _require_fit(self) -> None:
        """Refuse, before the first step and without moving anything real, an environment that would fail in it."""
        imagined = self.env.fake_tensordict()  # zeros; a reading of them need not be finite
        self._state.read(imagined, self._read, "state", finite=False)
        self._input(imagined, finite=False)
        if self._applied is not None:
            self._applied.read(imagined["next"], self.plant.actions, "applied", finite=False)
        elif "applied" in self.env.full_observation_spec:
            raise ValueError(
                "the environment reports the action that it has applied, as a safety layer does, but no reading reads "
                'it: give applied=Reading(keys=("applied",)), in the plant\'s units.'
            )
        limit = getattr(getattr(self.env, "spec", None), "max_episode_steps", None)  # of Gymnasium
        if limit is not None and limit < self.plant.n_steps:
            raise ValueError(
                f"the environment truncates an episode after {limit} of the {self.plant.n_steps} control intervals of "
                f"plant {self.plant.name!r}; use a horizon of at most {limit * self.plant.dt:g} s, or make the "
                "environment with a greater max_episode_steps."
            )
        key, names = self._actuation.key, [action.name for action in self.plant.actions]
        if key not in self.env.action_keys:
            raise ValueError(
                f"key={key!r} of the actuation is no action of the environment; it has {self.env.action_keys}."
            )
        spec = self.env.full_action_spec[key]
        if not isinstance(spec, Bounded | Unbounded) or spec.shape[len(self.env.batch_size) :].numel() != len(names):
            raise ValueError(f"the environment's action is {spec}; the plant needs continuous ones for {names}.")
        if isinstance(spec, Bounded):
            self._require_range(spec)

    def _require_range(self, spec: Bounded) -> None:
        bounds = (bound.double().reshape(-1) for bound in (spec.space.low, spec.space.high))
        ends = torch.stack([in_units(end, self._actuation.scale, self._actuation.offset) for end in bounds])
        for action, low, high in zip(self.plant.actions, ends.amin(0).tolist(), ends.amax(0).tolist(), strict=True):
            slack = 1e-6 * (action.high - action.low)  # bounds in single precision
            if low > action.low + slack or high < action.high - slack:
                raise ValueError(
                    f"action {action.name!r} of plant {self.plant.name!r} ranges over "
                    f"[{action.low:g}, {action.high:g}] {action.unit}, the environment's over [{low:g}, {high:g}]; "
                    "narrow the plant's, or mend scale and offset of the actuation."
                )

    def _input(self, reported: TensorDictBase, *, finite: bool = True) -> Float[Tensor, "1 n_z"]:
        inputs = self.plant.inputs
        if isinstance(self._exogenous, Reading):
            return self._exogenous.read(reported, inputs, "exogenous", finite=finite)
        if len(self._exogenous) != len(inputs):
            names = [signal.name for signal in inputs]
            raise ValueError(f"exogenous={self._exogenous} must be a Reading, or a constant for each input of {names}.")
        return torch.tensor([list(self._exogenous)], dtype=torch.float64, device=self.device).reshape(1, len(inputs))

    def _set_seed(self, seed: int | None) -> None:
        """Start the sequence of episodes that belongs to a seed; a system that takes no seed ignores it."""
        if self._seed is not None and seed is not None:
            self._seed, self._episodes = seed, 0

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """All that can be known of the real system's state: its seed and the number of episodes it has flown."""
        return {"seed": self._seed, "episodes": self._episodes}

    def load_state_dict(self, state: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        self._seed, self._episodes = state["seed"], state["episodes"]

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        # The seed counts episodes, not resets: a reset need not be followed by a step.
        options = {}
        if self._seed is not None:
            seed = episode_seed(self._seed, self._episodes)
            if any(isinstance(layer, GymWrapper) for layer in layers(self.env)):  # whose set_seed would reset once more
                options = {"seed": seed}
            else:
                self.env.set_seed(seed, static_seed=True)
        self._reported, self._step_count = self.env.reset(**options), 0
        if self._controller is not None:
            measured = self._measured(self._reported)
            self._memory = self._controller.start(measured.cpu(), self._input(self._reported).cpu())
        return self._begun()

    @property
    def pace(self) -> Any:
        """The pace that the environment keeps, such as the client of a plant; None if it keeps none."""
        return getattr(self.env, "pace", None)

    def go_on(self) -> TensorDictBase:
        """Begin the next window of operation without a reset: the present report is its first one, and t is 0 again."""
        for layer in layers(self.env):
            if isinstance(layer, AroundSystem):
                layer.begin_window()
        self._step_count = 0
        return self._begun()

    def _begun(self) -> TensorDict:
        return self._entries(self._reported, self._joined(self._reported), at_start(self.plant, self.device))

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._episodes += self._step_count == 0
        state, exogenous = self._present
        command = tensordict["action"]
        spec = self.env.full_action_spec[self._actuation.key]
        action = self._actuation.action(command[0]).reshape(spec.shape).to(spec.device, spec.dtype)
        stepped = self.env.step(self._reported.set(self._actuation.key, action))
        self._step_count += 1
        if self._applied is None:
            applied = self.plant.actuate(state, command)
        else:
            applied = self._applied.read(stepped["next"], self.plant.actions, "applied").to(self.device)
        t = torch.full((1,), (self._step_count - 1) * self.plant.dt, dtype=torch.float64, device=self.device)
        if self._controller is not None:
            known, measured = state[:, self._controller.measured], self._measured(stepped["next"])
            interval = t, self._memory, known, exogenous, applied, measured
            self._memory = self._controller.advance(*(values.cpu() for values in interval))
        end = self._joined(stepped["next"])
        cost = self.plant.running_cost(t, state, applied, exogenous)
        terminated = self.plant.end_cost is not None and bool(stepped["next", "terminated"].any())
        ends = at_end(self.plant, cost, end, last=self._step_count >= self.plant.n_steps, terminated=terminated)
        if stepped["next", "done"].any() and not ends["done"].any():
            raise ended_early(self._step_count, self.plant)
        if ends["done"].any() and hasattr(self.env, "end_episode"):
            self.env.end_episode()  # of a simulator that calls its controller, and has more to do
        self._reported = self.env.step_mdp(stepped)
        return self._entries(stepped["next"], end, {"applied": applied} | ends)

    def _measured(self, reported: TensorDictBase) -> Tensor:
        """The states that the environment reports."""
        return self._state.read(reported, self._read, "state")

    def _joined(self, reported: TensorDictBase) -> Float[Tensor, "1 n_s"]:
        """The plant's state, of what the environment reports and what the controller has computed."""
        measured = self._measured(reported)
        if self._controller is not None:
            measured = self._controller.joined(measured.cpu(), self._memory)
        return measured.to(self.device)

    def _entries(self, reported: TensorDictBase, state: Tensor, beside: dict[str, Tensor]) -> TensorDict:
        """The environment's report in the plant's terms, with what is beside its readings."""
        exogenous = self._input(reported).to(self.device)
        self._present = state, exogenous
        t = torch.full((1,), self._step_count * self.plant.dt, dtype=torch.float64, device=self.device)
        entries = {"observation": self.plant.observe(t, state, exogenous), "state": state, "exogenous": exogenous}
        entries |= beside | ({"refused": reported["refused"].reshape(1, 1)} if self._judged else {})
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def close(self, **kwargs: Any) -> None:
        """Close the environment too, such as its simulator or its connection."""
        self.env.close(**kwargs)
        super().close(**kwargs)
