"""The short-term memory D_S."""

import pytest

from rt_torchrl.steps.flight import ShortTermMemory


def test_short_term_memory_keeps_the_last_episodes_in_order():
    found = ShortTermMemory(2)
    for record in "abc":
        found.append(record)
    assert list(found) == ["b", "c"]
    with pytest.raises(ValueError, match="capacity=0"):
        ShortTermMemory(0)
