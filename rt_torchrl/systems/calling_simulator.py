"""An environment around a simulator that calls its controller instead of being stepped."""

from collections.abc import Callable, Mapping, Sequence
from queue import SimpleQueue
from threading import Thread
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from rt_torchrl.plants.signal import Signal, bounds

Report = Mapping[str, np.ndarray | Sequence[float]]
Controller = Callable[[Report], np.ndarray]
Simulation = Callable[[int, Controller], None]


class EpisodeAbandoned(BaseException):
    """Ends an episode that nobody goes on with; it is raised where the simulator calls its controller."""


class Conversation:
    """One episode of a simulator in a thread of its own, whose calls of the controller are answered from this thread.

    ``ended`` is true once the simulator has returned or failed: nobody listens to an answer any more.

    Args:
        simulate: function that runs the episode.
        seed: seed of the episode.
    """

    def __init__(self, simulate: Simulation, seed: int):
        self._simulate, self._seed, self.ended = simulate, seed, False
        self._reports: SimpleQueue[Report | BaseException | None] = SimpleQueue()
        self._actions: SimpleQueue[np.ndarray | None] = SimpleQueue()
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._simulate(self._seed, self._ask)
        except EpisodeAbandoned:
            pass
        except BaseException as error:  # any error goes to the thread that steps, because nobody sees this one
            self._reports.put(error)
        self._reports.put(None)

    def _ask(self, reported: Report) -> np.ndarray:
        self._reports.put(dict(reported))
        action = self._actions.get()
        if action is None:
            raise EpisodeAbandoned
        return action

    def listen(self) -> Report | None:
        """The next report of the simulator to its controller; None once the simulator has ended.

        Raises:
            RuntimeError: if the simulator has failed; the simulator's own error is its cause.
        """
        found = self._reports.get()
        self.ended = found is None or isinstance(found, BaseException)
        if isinstance(found, BaseException):
            raise RuntimeError(f"the simulator failed: {type(found).__name__}: {found}") from found
        return found

    def answer(self, action: np.ndarray | None) -> None:
        """Answer the simulator with the controller's action, or with None to abandon the episode."""
        self._actions.put(action)

    def end(self) -> None:
        """Abandon the rest of the episode and wait for the simulator to return."""
        if self._thread.is_alive():
            self.answer(None)
            self._thread.join()


class CallingSimulator(EnvBase):
    """An environment around a simulator that runs whole episodes itself and calls a controller in them.

    Co-simulation, Bladed-style controller libraries and many course codes work like this: ``simulate(seed,
    controller)`` runs an episode and calls ``action = controller(reported)`` once for every control interval, and a
    last time at the end of the episode, where the action has no effect any more. Here the simulator runs in a thread
    that waits until the environment is stepped. Where an episode is reset before its end, the controller call raises
    :class:`EpisodeAbandoned` in the simulator.

    Args:
        simulate: the simulator. ``reported`` maps names to the numbers behind them; the action is a vector in double
            precision.
        reports: number of values behind each reported name.
        actions: signals that the controller returns; their ranges become those of the environment's action.
        seed: seed of the first episode, until ``set_seed`` gives another; each later episode adds 1.

    Raises:
        ValueError: if ``reports`` or ``actions`` is empty, or a report lacks a name or has another size.
        RuntimeError: if the simulator fails, an episode never calls the controller, or the environment is stepped
            while no episode runs: before the first reset, or after an episode has ended or failed.
    """

    def __init__(self, simulate: Simulation, reports: Mapping[str, int], actions: Sequence[Signal], *, seed: int = 0):
        if not reports or not actions:
            raise ValueError(f"reports={dict(reports)} and actions={list(actions)} must not be empty.")
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([]))
        self._simulate, self._sizes, self._seed = simulate, dict(reports), seed
        self._conversation: Conversation | None = None
        double = {"dtype": torch.float64}
        self.observation_spec = Composite({name: Unbounded((n,), **double) for name, n in self._sizes.items()})
        low, high = bounds(actions)
        self.action_spec = Bounded(low, high, (len(actions),), **double)
        self.reward_spec = Unbounded((1,), **double)

    def _set_seed(self, seed: int | None) -> None:
        self._seed = self._seed if seed is None else seed

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        self.end_episode()
        self._conversation = Conversation(self._simulate, self._seed)
        self._seed += 1
        first = self._conversation.listen()
        if first is None:
            raise RuntimeError("the simulator has ended its episode without calling its controller once.")
        self._last = self._entries(first)
        return self._last.clone()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Step to the next call of the controller; once the simulator has ended, repeat its last report and be done."""
        if self._conversation is None or self._conversation.ended:
            raise RuntimeError("no episode is running; reset the environment before it is stepped.")
        self._conversation.answer(tensordict["action"].numpy().copy())
        reported = self._conversation.listen()
        if reported is not None:
            self._last = self._entries(reported)
        ended = torch.full((1,), reported is None)
        ends = {"done": ended, "terminated": ended.clone(), "reward": torch.zeros(1, dtype=torch.float64)}
        return self._last.clone().update(ends)

    def _entries(self, reported: Report) -> TensorDict:
        found: dict[str, Tensor] = {}
        for name, size in self._sizes.items():
            values = reported.get(name)
            if values is None or np.shape(values) != (size,):
                raise ValueError(
                    f"the simulator reports {name}={values!r}; it must be {size} numbers, as declared in `reports`."
                )
            found[name] = torch.as_tensor(np.asarray(values, dtype=np.float64))
        return TensorDict(found, batch_size=self.batch_size)

    def end_episode(self) -> None:
        """Abandon the running episode, if there is one."""
        if self._conversation is not None:
            self._conversation.end()
            self._conversation = None

    def close(self, **kwargs: Any) -> None:
        self.end_episode()
        super().close(**kwargs)
