"""The memory of step 2: prioritised replay of TorchRL, and the paper's choice of what gives way when it is full."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, RoundRobinWriter, TensorDictPrioritizedReplayBuffer

CORRECTION = 0.4
"""Exponent of the importance weights; 1 removes the bias of the prioritised sampling."""
TOL = 1e-3
"""Number tol that is added to every |δ|, so that every transition can be sampled."""


class LongTermMemory:
    r"""The memory D_L, which samples transitions by priority.

    .. math:: P(i) = (|\delta_i| + tol)^{\alpha^*} / \sum_k(|\delta_k| + tol)^{\alpha^*}

    When it is full, new transitions replace those with the least probability of being sampled (paper, section 4.3).
    It stands on the CPU.

    Args:
        capacity: number n_L of transitions that the memory keeps, by default of all episodes of most trainings.
        prioritisation: exponent α* of the sampling probability; 0 samples uniformly.
        correction: exponent of the importance weights.
        generator: source of the samples.
    """

    def __init__(
        self,
        capacity: int = 100_000,
        *,
        prioritisation: float = 0.6,
        correction: float = CORRECTION,
        generator: torch.Generator,
    ):
        self.capacity, self.prioritisation, self.correction = capacity, prioritisation, correction
        self._generator = generator
        if generator.device.type != "cpu":
            seed = torch.randint(2**62, (), generator=generator, device=generator.device)
            self._generator = torch.Generator(device="cpu").manual_seed(int(seed))
        self._clear()

    def _clear(self) -> None:
        self._writer = LeastPriorityWriter(self.capacity)
        # It takes priorities as they are, because a power is rounded by the place of its number in the memory, and a
        # training that goes on from a saved state has to sample the same.
        self.buffer = TensorDictPrioritizedReplayBuffer(
            alpha=1.0,
            beta=self.correction,
            eps=0.0,
            storage=LazyTensorStorage(self.capacity, device="cpu"),
            sampler_device="cpu",
        )
        self.buffer.set_writer(self._writer)
        self.buffer.set_rng(self._generator)

    def __len__(self) -> int:
        return len(self.buffer)

    def store(self, transitions: TensorDictBase, td_errors: Float[Tensor, " n"]) -> None:
        """Add transitions, a TensorDict of batch size n, with their TD errors δ."""
        index = self.buffer.extend(transitions.cpu())
        self.refresh(index, td_errors)

    def sample(self, count: int) -> TensorDictBase:
        """Draw transitions, with their ``index`` (for :meth:`refresh`) and importance weight ``priority_weight``."""
        return self.buffer.sample(count)

    def observations(self) -> Float[Tensor, "n n_o"]:
        """Observations of all transitions, in no particular order."""
        return self.buffer[:]["observation"]

    def refresh(self, index: Int[Tensor, " n"], td_errors: Float[Tensor, " n"]) -> None:
        """Give sampled transitions their new TD errors δ; of several for one transition the last one counts.

        Raises:
            FloatingPointError: if one is not finite in single precision, as after an update that has diverged; none is
                then given.
        """
        errors = td_errors.detach().float().cpu().abs()  # a sampler with a generator draws in single precision
        if not errors.isfinite().all():
            raise FloatingPointError("a TD error exceeds single precision; use a smaller twinning.learner.reward_scale")
        self._prioritise(index.cpu(), (errors + TOL) ** self.prioritisation)

    def _prioritise(self, index: Int[Tensor, " n"], priorities: Float[Tensor, " n"]) -> None:
        self._writer.priorities[index.numpy()] = priorities.numpy()
        self.buffer.update_tensordict_priority(TensorDict({"index": index, "td_error": priorities}, [len(index)]))

    def state_dict(self) -> dict[str, Any]:
        """The transitions in their places with their priorities."""
        count = len(self)
        if not count:
            return {"count": 0}
        stored = self.buffer[:].flatten_keys(".").to_dict()
        priorities = torch.from_numpy(self._writer.priorities[:count].copy())
        generator = self._generator.get_state()
        return {"count": count, "transitions": stored, "priorities": priorities, "generator": generator}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._clear()
        if count := state["count"]:
            transitions = TensorDict(state["transitions"], batch_size=[count], device="cpu")
            index = self.buffer.extend(transitions.unflatten_keys("."))
            self._prioritise(index, state["priorities"].cpu())
            self._generator.set_state(state["generator"].cpu())


class LeastPriorityWriter(RoundRobinWriter):
    """A writer that fills the storage in order, and then overwrites the transitions with the least current priority.

    TorchRL's ``TensorDictMaxValueWriter`` ranks transitions by their value when they are written. The paper ranks them
    by the sampling probability, which changes with every update of the critic.

    Args:
        capacity: number of places.
    """

    def __init__(self, capacity: int):
        super().__init__()
        self.priorities = np.zeros(capacity, dtype=np.float32)
        """Priority of the transition in each place; of equal ones the first goes first."""

    def extend(self, data: TensorDictBase) -> Int[Tensor, " n"]:
        """Write transitions, of which there are no more than places, and return their places."""
        stored, capacity, n = len(self._storage), len(self.priorities), len(data)
        free = np.arange(stored, min(stored + n, capacity))
        evicted = self.priorities[:stored].argsort(kind="stable")[: n - len(free)]
        index = torch.from_numpy(np.concatenate([free, evicted]))
        data.set("index", index)
        self._storage.set(index, data)
        return index
