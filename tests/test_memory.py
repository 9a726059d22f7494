"""The long-term memory: probabilities, weights, refresh, eviction, saving; the short-term one."""

import copy

import pytest
import torch
from scipy.stats import chisquare
from tensordict import TensorDict

from rt_torchrl.twinning.learners.config import LongTermMemoryConfig
from rt_torchrl.twinning.learners.long_term_memory import AT_ONCE, LongTermMemory
from rt_torchrl.twinning.short_term_memory import ShortTermMemory


def memory(capacity=10, seed=0, **options):
    config = LongTermMemoryConfig(capacity=capacity, **options)
    return LongTermMemory(config, generator=torch.Generator().manual_seed(seed))


def transitions(labels):
    return TensorDict({"label": torch.tensor(labels, dtype=torch.float64)}, batch_size=[len(labels)])


def labels(found):
    return sorted(found._buffer[: len(found)]["label"].tolist())


ERRORS = torch.tensor([0.0, 0.1, 0.5, 1.0, 2.0, 5.0, 0.3, 0.3], dtype=torch.float64)


@pytest.mark.parametrize("alpha", [0.0, 0.6, 1.0])
def test_sampling_follows_the_priorities(alpha):
    """P(i) ∝ (|δ_i| + tol)^α*, by a χ² test at 0.1 %; the draws are seeded, so the outcome is always the same."""
    tol = 0.05
    found = memory(prioritisation=alpha, offset=tol)
    found.store(transitions(list(range(8))), -ERRORS)
    counts = torch.zeros(8)
    for _ in range(40):
        counts += found.sample(500)["label"].long().bincount(minlength=8)
    weights = (ERRORS + tol) ** alpha
    expected = 20_000 * weights / weights.sum()
    assert chisquare(counts.numpy(), expected.numpy() * counts.sum().item() / expected.sum().item()).pvalue > 1e-3


def test_importance_weights_undo_the_sampling():
    """w_i = (P_min/P_i)^β: one for the least likely, and for β = 1 the weighted draw is uniform."""
    found = memory(prioritisation=0.8, correction=0.7, offset=0.05)
    found.store(transitions(list(range(8))), ERRORS)
    batch = found.sample(400)
    P = (ERRORS + 0.05) ** 0.8
    expected = (P.min() / P[batch["label"].long()]) ** 0.7
    # Priorities are kept in single precision.
    torch.testing.assert_close(batch["priority_weight"].double(), expected, rtol=1e-5, atol=0)


def test_refreshed_errors_change_the_sampling():
    found = memory(prioritisation=1.0, offset=1e-6)
    found.store(transitions([0.0, 1.0, 2.0]), torch.tensor([1.0, 0.0, 0.0]))
    assert (found.sample(200)["label"] == 0.0).all()
    batch = TensorDict({"index": torch.tensor([0, 2])}, batch_size=[2])
    found.refresh(batch["index"], torch.tensor([0.0, -3.0]))
    # The others have a share of 2e-6/3 each.
    assert (found.sample(200)["label"] == 2.0).all()


def test_index_of_a_sample_is_its_place():
    found = memory()
    found.store(transitions([4.0, 5.0, 6.0]), torch.ones(3))
    batch = found.sample(50)
    assert torch.equal(batch["label"], 4.0 + batch["index"])


def test_eviction_goes_by_the_present_priorities():
    """Errors rank one way at first and the other way after a refresh; the transitions that are now least go first."""
    found = memory(capacity=6)
    found.store(transitions([0.0, 1.0, 2.0, 3.0]), torch.tensor([9.0, 8.0, 0.1, 0.2]))
    found.store(transitions([4.0, 5.0]), torch.tensor([5.0, 5.0]))
    found.refresh(torch.tensor([0, 1, 2, 3]), torch.tensor([0.1, 0.2, 9.0, 8.0]))
    found.store(transitions([6.0, 7.0]), torch.tensor([1.0, 1.0]))
    assert labels(found) == [2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    # Now 6 and 7 are least; the newcomer takes the place of one of them, with its own priority.
    found.store(transitions([8.0]), torch.tensor([50.0]))
    assert labels(found)[:4] == [2.0, 3.0, 4.0, 5.0] and 8.0 in labels(found) and len(found) == 6
    drawn = found.sample(2000)["label"]
    assert {2.0, 3.0, 4.0, 5.0, 8.0} <= set(drawn.tolist()) and drawn.mode().values == 8.0


def test_filling_up_in_the_middle_of_an_episode():
    found = memory(capacity=5)
    found.store(transitions([0.0, 1.0, 2.0]), torch.tensor([3.0, 1.0, 2.0]))
    found.store(transitions([3.0, 4.0, 5.0, 6.0]), torch.full((4,), 0.5))
    # Two free places and the two of least priority, 1 and 2.
    assert labels(found) == [0.0, 3.0, 4.0, 5.0, 6.0]


def test_filling_up_one_by_one():
    """An episode as long as its returns has one transition."""
    found = memory(capacity=2)
    for label in (0.0, 1.0, 2.0):
        found.store(transitions([label]), torch.tensor([3.0 - label]))
    assert labels(found) == [0.0, 2.0]


def test_state_round_trip_samples_the_same():
    first, second = memory(seed=1), memory(seed=1)
    first.store(transitions(list(range(8))), ERRORS)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    assert len(second) == 8
    assert torch.equal(first.sample(100)["label"], second.sample(100)["label"])
    for each in (first, second):
        each.refresh(torch.tensor([0]), torch.tensor([7.0]))
        each.store(transitions([10.0, 11.0, 12.0]), torch.ones(3))
    # Label 1 had the least error once 0 was refreshed: it is evicted from both.
    assert labels(first) == labels(second) and 1.0 not in labels(second) and 0.0 in labels(second)


def test_many_samples_are_those_of_single_calls():
    many, single = memory(seed=1), memory(seed=1)
    for each in (many, single):
        each.store(transitions(list(range(8))), ERRORS)
    count = 2 * AT_ONCE + 3
    drawn = list(many.samples(16, count))
    expected = [single.sample(16) for _ in range(count)]
    for one, other in zip(drawn, expected, strict=True):
        assert torch.equal(one["label"], other["label"])
        # Powers of few numbers and of many are rounded apart.
        torch.testing.assert_close(one["priority_weight"], other["priority_weight"])
    assert torch.equal(many.sample(5)["label"], single.sample(5)["label"])
    assert not list(many.samples(16, 0))


def test_an_episode_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="11 transitions at once do not fit a long-term memory of 10"):
        memory().store(transitions(list(range(11))), torch.ones(11))


@pytest.mark.parametrize(
    "change", [{"capacity": 0}, {"prioritisation": 1.5}, {"prioritisation": -0.1}, {"correction": 2.0}, {"offset": 0.0}]
)
def test_wrong_parameters_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        LongTermMemoryConfig(**change)


def test_short_term_memory_keeps_the_last_episodes_in_order():
    found = ShortTermMemory(2)
    for record in "abc":
        found.append(record)
    assert list(found) == ["b", "c"]
    with pytest.raises(ValueError, match="capacity=0"):
        ShortTermMemory(0)


def test_draws_and_renewals_are_those_of_torchrls_sampler():
    one, other = memory(seed=1), memory(seed=1)
    generator = torch.Generator().manual_seed(2)
    for each in (one, other):
        each.store(transitions(list(range(8))), ERRORS)
    for count in (16, 1, 5):
        drawn = one.sample(count)
        index, weight = other.draw(count)
        assert torch.equal(drawn["index"], index) and torch.equal(drawn["priority_weight"], weight)
        assert torch.equal(drawn["label"], other.transitions()["label"][index])
        errors = 200.0 * torch.rand(count, generator=generator)
        one.sampler.update_priority(index, errors)
        other.refresh(index, errors)
        assert torch.equal(one.sampler.priorities(8), other.sampler.priorities(8))
        assert [float(x) for x in one.sampler._max_priority] == [float(x) for x in other.sampler._max_priority]


def test_a_draw_from_an_empty_memory_is_refused():
    with pytest.raises(ValueError, match="memory is empty"):
        memory().draw(3)
