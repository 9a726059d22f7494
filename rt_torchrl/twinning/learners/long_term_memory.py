"""The long-term memory D_L: the transitions that critics learn from, sampled by priority."""

from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float, Int
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, PrioritizedSampler, TensorDictReplayBuffer, Writer

from rt_torchrl.twinning.learners.config import LongTermMemoryConfig

AT_ONCE = 100
"""Number of batches drawn in one call: with as many its overhead does not matter, and their copies are still small."""


class LongTermMemory:
    r"""The memory D_L, which samples transitions by priority.

    .. math:: P(i) = (|\delta_i| + tol)^{\alpha^*} / \sum_k(|\delta_k| + tol)^{\alpha^*}

    When it is full, new transitions replace those with the least probability of being sampled (paper, section 4.3).

    Args:
        config: parameters of D_L.
        generator: source of the samples.
    """

    def __init__(self, config: LongTermMemoryConfig, *, generator: torch.Generator):
        self._config, self._device, self._generator = config, generator.device, on_cpu(generator)
        self._clear()

    def _clear(self) -> None:
        config = self._config
        self.sampler = PriorityReader(
            config.capacity, alpha=config.prioritisation, beta=config.correction, eps=config.offset
        )
        self._buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(config.capacity, device=self._device),
            sampler=self.sampler,
            writer=LeastPriorityWriter(self.sampler),
        )
        self._buffer.set_rng(self._generator)

    def __len__(self) -> int:
        return len(self._buffer)

    def store(self, transitions: TensorDictBase, td_errors: Float[Tensor, " n"]) -> None:
        """Add transitions, a TensorDict of batch size n, with their TD errors δ."""
        index = self._buffer.extend(transitions)
        self.refresh(index, td_errors)

    def sample(self, batch_size: int) -> TensorDict:
        """Draw transitions, with their ``index`` (for :meth:`refresh`) and importance weight ``priority_weight``."""
        return self._buffer.sample(batch_size)

    def samples(self, batch_size: int, count: int) -> Iterator[TensorDict]:
        """Draw ``count`` batches, as the same number of calls of :meth:`sample` would while no priority changes.

        One call draws many batches, because drawing a single batch takes half as long as a gradient of the policy.
        """
        for left in range(count, 0, -AT_ONCE):
            yield from self.sample(min(left, AT_ONCE) * batch_size).split(batch_size)

    def draw(self, count: int) -> tuple[Int[Tensor, " n"], Float[Tensor, " n"]]:
        """Places and importance weights of the transitions that :meth:`sample` would draw, on the CPU.

        The transitions of a place are the row of :meth:`transitions` with that number.
        """
        return self.sampler.draw(count, len(self), self._generator)

    def transitions(self) -> TensorDict:
        """All transitions, in the order of their places."""
        return self._buffer[:]

    def observations(self) -> Float[Tensor, "n n_o"]:
        """Observations of all transitions, in no particular order."""
        return self.transitions()["observation"]

    def refresh(self, index: Int[Tensor, " n"], td_errors: Float[Tensor, " n"]) -> None:
        """Give sampled transitions their new TD errors δ.

        Raises:
            FloatingPointError: if one is not finite in single precision; none is then given.
        """
        # A sampler with a generator draws in single precision.
        errors = td_errors.detach().float().cpu().abs()
        if not errors.isfinite().all():
            raise FloatingPointError("a TD error is not finite")
        self.sampler.renew(index.cpu(), errors)

    def state_dict(self) -> dict[str, Any]:
        """The transitions in their places, and the leaves of the trees that sample them.

        The trees themselves are objects of TorchRL; all their other nodes are sums or minima of the leaves.
        """
        count = len(self)
        if not count:
            return {"count": 0}
        stored = self.transitions().flatten_keys(".").to_dict()
        leaves = {name: self.sampler.leaves(name, count) for name in TREES}
        own = {} if self._generator.device == self._device else {"generator": self._generator.get_state()}
        return {"count": count, "transitions": stored, "max_priority": self.sampler._max_priority} | leaves | own

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._clear()
        count = state["count"]
        if not count:
            return
        transitions = TensorDict(state["transitions"], batch_size=[count], device=self._device)
        places = torch.arange(count, device="cpu")
        self._buffer._storage.set(places, transitions.unflatten_keys("."))
        for name in TREES:
            getattr(self.sampler, name)[places] = state[name].cpu()
        self.sampler._max_priority = state["max_priority"]
        if "generator" in state:
            self._generator.set_state(state["generator"].cpu())


TREES = ("_sum_tree", "_min_tree")


class PriorityReader(PrioritizedSampler):
    """A prioritised sampler whose priorities can be read, and that draws and renews them at once.

    TorchRL's trees take arrays of NumPy ten times as fast as tensors, and a learner draws thousands of batches.
    """

    def draw(
        self, count: int, stored: int, generator: torch.Generator
    ) -> tuple[Int[Tensor, " {count}"], Float[Tensor, " {count}"]]:
        """Places and importance weights as ``sample`` gives them, of the first ``stored`` transitions."""
        total, least = self._sum_tree.query(0, stored), self._min_tree.query(0, stored)
        if not stored:
            raise ValueError("the long-term memory is empty; store an episode before an update.")
        if not least > 0.0:
            raise ValueError(f"the least priority is {least}; raise the memory's offset, or lower its prioritisation.")
        mass = torch.rand(count, generator=generator, device="cpu").mul_(total)
        index = np.atleast_1d(self._sum_tree.scan_lower_bound(mass.numpy()))
        np.minimum(index, stored - 1, out=index)  # a mass may be rounded up to the total
        priority = torch.from_numpy(np.atleast_1d(self._sum_tree.at(index)))
        return torch.from_numpy(index), priority.div_(least).pow_(-self._beta)

    def largest(self) -> Tensor | None:
        """The largest error |δ| so far; None if there was none."""
        priority, _ = self._max_priority
        return cast(Tensor | None, priority)

    def renew(self, index: Int[Tensor, " n"], errors: Float[Tensor, " n"]) -> None:
        """What ``update_priority`` does, for errors |δ| on the CPU."""
        places, largest, known = index.numpy(), errors.max(), self.largest()
        if known is None or largest > known:
            self._max_priority = (largest, index[errors.argmax()])
        priority = torch.pow(errors + self._eps, self._alpha).numpy()
        self._sum_tree.update(places, priority)
        self._min_tree.update(places, priority)

    def priorities(self, count: int) -> Float[Tensor, " {count}"]:
        """Priorities (|δ_i| + tol)^α* of the first ``count`` transitions."""
        return self.leaves("_sum_tree", count)

    def leaves(self, tree: str, count: int) -> Float[Tensor, " {count}"]:
        """Leaves of a tree for the first ``count`` transitions."""
        # For a single transition the tree returns a scalar.
        return torch.as_tensor(getattr(self, tree)[torch.arange(count, device="cpu")], device="cpu").reshape(count)


class LeastPriorityWriter(Writer):
    """A writer that fills the storage in order, and then overwrites the transitions with the least current priority.

    TorchRL's ``TensorDictMaxValueWriter`` ranks transitions by their value when they are written. The paper ranks them
    by the sampling probability, which changes with every update of the critic.

    Args:
        sampler: sampler that holds the current priorities.
    """

    def __init__(self, sampler: PriorityReader):
        super().__init__()
        self._sampler = sampler

    def add(self, data: TensorDictBase) -> int:
        return int(self.extend(data.unsqueeze(0))[0])

    def extend(self, data: TensorDictBase) -> Int[Tensor, " n"]:
        stored, capacity, n = len(self._storage), self._storage.max_size, len(data)
        if n > capacity:
            raise ValueError(
                f"{n} transitions at once do not fit a long-term memory of {capacity}; raise capacity to at least one "
                "episode."
            )
        free = torch.arange(stored, min(stored + n, capacity), device="cpu")
        evicted = self._sampler.priorities(stored).argsort(stable=True)[: n - len(free)]
        index = torch.cat([free, evicted])
        data.set("index", index)
        self._storage.set(index, data)
        return index

    def _empty(self, empty_write_count: bool = True) -> None:
        """Forget nothing, because the storage knows its length and the sampler its priorities."""

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore nothing, because the writer has no state; see :meth:`_empty`."""

    def dumps(self, path: str) -> None:
        """Write nothing, because the writer has no state; see :meth:`_empty`."""

    def loads(self, path: str) -> None:
        """Read nothing, because the writer has no state; see :meth:`_empty`."""


def on_cpu(generator: torch.Generator) -> torch.Generator:
    """A generator for the sampler, whose tree is on the CPU: the given one if it is there, else one that it seeds."""
    if generator.device.type == "cpu":
        return generator
    seed = torch.randint(2**62, (), generator=generator, device=generator.device)
    return torch.Generator(device="cpu").manual_seed(int(seed))
