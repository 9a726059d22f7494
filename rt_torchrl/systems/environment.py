"""The real system in simulation: any plant as a TorchRL environment, and environments around systems."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, TransformedEnv

from rt_torchrl.options import require_number, require_range
from rt_torchrl.plants.plant import Plant, with_memories
from rt_torchrl.plants.shapes import Cost, State
from rt_torchrl.plants.signal import Signal, bounds
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.trajectory import Scenario


class PlantEnv(EnvBase):
    r"""A plant with its true closure, stepped by commands.

    The algorithm flies this class by machine code. It flies a subclass, which may override a step, step by step, and
    that is far slower.

    The TensorDict has these entries, each with the batch size (1,) in front:

    =====================================  ======  ===================================================================
    ``observation``                        n_o     the tracking errors e_k
    ``state``, ``exogenous``               n_r, z  readings of s_k, and z_k, which a record holds beside actions
    ``action``                             n_a     the command, within the ranges of the plant's actions
    ``("next", "applied")``                n_a     the action that the actuators applied
    ``("next", "reward")``                 1       −L_a(t_k, s_k, a_k, z_k); at the end also −Φ_a/Δt
    ``("next", "truncated")``              1       true at the horizon
    ``("next", "terminated")``             1       true where the plant's episode has ended early (:meth:`Plant.ended`)
    =====================================  ======  ===================================================================

    Args:
        plant: the plant; its own closure is the true one.
        seed: seed of the generator that draws initial states and exogenous inputs.
        device: device on which the environment runs.
        noise: standard deviation of the sensors' error as a share of the value that they read. Every reported state is
            s(1 + noise·w), where w is standard normal. The observation and L_a are computed from it, as in front of a
            machine; Φ_a and an early end are those of the true state. What a controller memorises
            (:attr:`Plant.memories`) is what was measured then, and gets no further noise.

    Raises:
        ValueError: if ``noise`` is out of its range.
    """

    def __init__(
        self,
        plant: Plant,
        *,
        seed: int = 0,
        device: torch.device | str = "cpu",
        noise: float = 0.0,
    ):
        require_number("seed", seed, whole=True)
        require_range("noise", noise, 0.0, 1.0, unit="-", of="the sensors")
        super().__init__(device=torch.device(device), batch_size=torch.Size([1]))
        self.plant = plant.to(device)
        self._generator = torch.Generator(device=device)
        # The sensors have their own generator, so that sensors of any quality see the same disturbances.
        self._sensors = torch.Generator(device=device)
        self._set_seed(seed)
        self._noise = noise
        declare_specs(self, plant)

    @property
    def closure(self) -> nn.Module:
        """The true closure."""
        return self.plant.closure

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._generator.manual_seed(seed)
            self._sensors.manual_seed(seed + 1)

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Everything that the next reset depends on."""
        return {"generator": self._generator.get_state(), "sensors": self._sensors.get_state()}

    def load_state_dict(self, state: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        self._generator.set_state(state["generator"].cpu())
        self._sensors.set_state(state["sensors"].cpu())

    def _draw(self) -> tuple[Tensor, Tensor]:
        """Initial state and exogenous inputs of the next episode."""
        return self.plant.draw_initial_state(1, self._generator), self.plant.draw_exogenous(1, self._generator)

    def pass_over(self) -> None:
        """Draw what a reset would draw, and discard it.

        The algorithm passes over one draw before each of its episodes, so that its episodes are every second draw of a
        seed. The collector of version 0.1 reset twice in each episode; in this way the figures of version 0.1 still
        hold.
        """
        self._draw()
        self.sensor_factor()

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        self._state, self._exogenous = self._draw()
        self._step_count = 0
        if self.plant.ended(self._state).any():
            raise ValueError(f"plant {self.plant.name!r} draws initial states in which the episode has ended.")
        return self._observed(at_start(self.plant, self.device))

    @property
    def drawn(self) -> tuple[Scenario, Float[Tensor, "1 n_s"]]:
        """Initial state and exogenous inputs of the last reset, and the sensors' factors on the first state."""
        return Scenario(self._state, self._exogenous), self._factor

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        t, exogenous = self._now()
        command = tensordict["action"]
        transition = self.plant.step(t, self._state, command, exogenous, self.closure)
        cost = self.plant.running_cost(t, self._state * self._factor, transition.applied, exogenous)
        if not cost.isfinite().all() or not transition.state.isfinite().all():
            raise DivergenceError(
                f"plant {self.plant.name!r} diverged at t = {t.item():g} s: state {self._state.tolist()}, "
                f"command {command.tolist()}, exogenous input {exogenous.tolist()}."
            )
        self._state = with_memories(self.plant, transition.state, t, self._state * self._factor, exogenous)
        self._step_count += 1
        ends = at_end(self.plant, cost, self._state, last=self._step_count >= self.plant.n_steps)
        return self._observed({"applied": transition.applied.clone()} | ends)

    def _observed(self, entries: dict[str, Tensor]) -> TensorDict:
        t, exogenous = self._now()
        self._factor = self.sensor_factor()
        state = self._state * self._factor
        observation = self.plant.observe(t, state, exogenous)
        read = state[..., : len(self.plant.readings)]
        entries |= {"observation": observation, "state": read, "exogenous": exogenous}
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def sensor_factor(self) -> Float[Tensor, "1 n_s"]:
        """The sensors' factors on the state at the next reading, 1 + noise·w; 1 for what no sensor reads."""
        shape, like = (1, len(self.plant.states)), {"dtype": torch.float64, "device": self.device}
        if self._noise == 0.0:
            return torch.ones(shape, **like)
        drawn = 1.0 + self._noise * torch.randn(shape, generator=self._sensors, **like)
        read = [signal.name not in self.plant.memories for signal in self.plant.states]
        read[len(self.plant.readings) :] = [False] * self.plant.unread
        return torch.where(torch.tensor(read, device=self.device), drawn, 1.0)

    def _now(self) -> tuple[Float[Tensor, " 1"], Float[Tensor, "1 n_z"]]:
        """Time and exogenous input of this interval; after the last interval, the input is that of the last one."""
        k = self._step_count
        t = torch.full((1,), k * self.plant.dt, dtype=torch.float64, device=self.device)
        return t, self._exogenous[:, min(k, self.plant.n_steps - 1)]


def at_start(plant: Plant, device: torch.device | None) -> dict[str, Tensor]:
    """What a reset reports beside its readings: no action was applied, and the episode goes on."""
    flags = {key: torch.zeros(1, 1, dtype=torch.bool, device=device) for key in ("done", "terminated", "truncated")}
    return {"applied": torch.zeros(1, len(plant.actions), dtype=torch.float64, device=device)} | flags


def at_end(plant: Plant, cost: Cost, end: State, *, last: bool, terminated: bool = False) -> dict[str, Tensor]:
    """The reward of a control interval, and whether the episode is over.

    Args:
        plant: the plant.
        cost: running cost of the interval.
        end: state at its end.
        last: whether the horizon is reached.
        terminated: whether the system says that the episode has ended, whatever the state says.

    Returns:
        ``reward``, which has the cost at the end where the episode is over, and the flags.
    """
    over = plant.ended(end).unsqueeze(-1) | terminated
    truncated = ~over & last
    done = truncated | over
    reward = -(cost + done.squeeze(-1) * plant.terminal_cost(end) / plant.dt).unsqueeze(-1)
    return {"reward": reward, "done": done, "terminated": over, "truncated": truncated}


def declare_specs(env: EnvBase, plant: Plant, *, refused: bool = False) -> None:
    """Give an environment the entries of a plant, see :class:`PlantEnv`, and ``refused`` where a layer judges them."""
    batch, device = env.batch_size, env.device
    flag = Binary(n=1, shape=(*batch, 1), dtype=torch.bool, device=device)
    groups = {"observation": plant.observations, "state": plant.readings}
    groups |= {"exogenous": plant.inputs, "applied": plant.actions}
    entries: dict[str, TensorSpec] = {
        key: Unbounded(shape=(*batch, len(group)), dtype=torch.float64, device=device) for key, group in groups.items()
    }
    entries |= {"refused": flag.clone()} if refused else {}
    env.observation_spec = Composite(entries, shape=batch, device=device)
    low, high = (end.expand(*batch, -1) for end in bounds(plant.actions, device=device))
    env.action_spec = Bounded(low=low, high=high, shape=low.shape, dtype=torch.float64).to(device)
    env.reward_spec = Unbounded(shape=(*batch, 1), dtype=torch.float64, device=device)
    env.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=batch, device=device)


class ForeignSystem(EnvBase):
    """One system without a batch that somebody else makes: it reports vectors by name, and its rewards are zero.

    Args:
        sizes: number of components of each vector.
        actions: signals of the actions; their ranges become those of the environment's action.
        seed: seed of the first episode, until ``set_seed`` gives another.
    """

    def __init__(self, sizes: Mapping[str, int], actions: Sequence[Signal], *, seed: int = 0):
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([]))
        double = {"dtype": torch.float64}
        self.observation_spec = Composite({name: Unbounded((n,), **double) for name, n in sizes.items()})
        low, high = bounds(tuple(actions))
        self.action_spec = Bounded(low, high, (len(actions),), **double)
        self.reward_spec = Unbounded((1,), **double)
        self._seed = seed

    def _set_seed(self, seed: int | None) -> None:
        self._seed = self._seed if seed is None else seed

    def _stepped(self, reported: TensorDict, *, ended: bool = False) -> TensorDict:
        """What a step returns, made of what the system reports at its end."""
        done = torch.full((1,), ended)
        ends = {"done": done, "terminated": done.clone(), "reward": torch.zeros(1, dtype=torch.float64)}
        return reported.update(ends)


def ended_early(count: int, plant: Plant) -> ValueError:
    """The error that says that an environment has ended an episode where its plant does not.

    Args:
        count: number of control intervals until that end.
        plant: plant whose horizon the episode has not reached.
    """
    return ValueError(
        f"the environment ended the episode after {count} of {plant.n_steps} control intervals of plant "
        f"{plant.name!r}, which does not end there. If it may, let the plant say so by ended(state) and end_cost; or "
        f"use a horizon of at most {count * plant.dt:g} s, or an environment that goes on."
    )


class AroundSystem(EnvBase):
    """An environment around the system ``env``, whose attributes it has where it has none of that name."""

    env: EnvBase

    def __getattr__(self, name: str) -> Any:
        """An attribute of the system, such as ``plant``, where the environment around it has none of that name."""
        try:
            return super().__getattr__(name)
        except AttributeError:
            if name.startswith("_") or name == "env":
                raise
            return getattr(self.env, name)

    def begin_window(self) -> None:
        """Begin the next window of an operation without a reset; by default nothing depends on it."""

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """State of the system; what stands around it has none that outlives an episode."""
        return self.env.state_dict(*args, **kwargs)

    def load_state_dict(self, state: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        self.env.load_state_dict(state, *args, **kwargs)

    def close(self, **kwargs: Any) -> None:
        """Close the system too, such as its connection or its window."""
        self.env.close(**kwargs)
        super().close(**kwargs)

    def _set_seed(self, seed: int | None) -> None:
        self.env.set_seed(seed)


def layers(env: EnvBase) -> Iterator[EnvBase]:
    """A system and those within it, from the outside in; a transformed one is followed by that which it transforms."""
    while isinstance(env, EnvBase):
        yield env
        env = env.base_env if isinstance(env, TransformedEnv) else getattr(env, "env", None)
