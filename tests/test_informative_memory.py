"""The memory that keeps the episodes that tell most, against determinants of regression."""

import itertools

import numpy as np
import pytest
import torch
from straight_line import Line, Slope, line_segment

from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.assimilation import Assimilation, AssimilationConfig
from rt_torchrl.twinning.informative_memory import InformativeMemory

TIMES = 0.1 * np.arange(21)


def assimilation(**options):
    config = AssimilationConfig(**{"inputs": "record", "method": "levenberg_marquardt"} | options)
    return Assimilation(DigitalTwin(Line(), Slope()), config)


def record(wind):
    return line_segment(0.0 * TIMES, wind=wind)


def information(winds):
    """Of w_0 + w_1 z from known starts: Σ z zᵀ Σ t² dt."""
    rows = np.array([[1.0, z] for z in winds])
    return np.linalg.det(rows.T @ rows)


def test_what_is_kept_tells_most_with_the_latest():
    """Winds 1 … 1.2 are alike; a calm and a storm tell the slopes apart. Every choice of two, by determinants."""
    memory, winds = InformativeMemory(assimilation(), 2), [1.0, 1.1, 4.0, 0.9, -2.0, 1.2]
    kept = []
    for wind in winds:
        memory.consider(record(wind), [record(1.0)])
        kept.append(wind)
        if len(kept) > 2:
            kept = list(max(itertools.combinations(kept, 2), key=lambda pair: information([*pair, 1.0])))
    assert sorted(one.exogenous[0, 0].item() for one in memory.records) == sorted(kept) == [-2.0, 4.0]
    assert len(memory.with_latest([record(1.0)])) == 3


def test_records_survive_a_checkpoint():
    memory, other = (InformativeMemory(assimilation(), 2) for _ in range(2))
    for wind in (1.0, 3.0):
        memory.consider(record(wind), [])
    other.load_state_dict(memory.state_dict())
    assert all(torch.equal(a.exogenous, b.exogenous) for a, b in zip(memory.records, other.records, strict=True))


def test_no_memory_keeps_nothing_and_asks_nothing():
    memory = InformativeMemory(assimilation(inputs="realisations"), 0)
    memory.consider(record(1.0), [])
    assert memory.with_latest([]) == []


def test_what_the_memory_needs_is_demanded():
    with pytest.raises(ValueError, match="informative=-1"):
        InformativeMemory(assimilation(), -1)
    with pytest.raises(ValueError, match=r"informative=1 records need .* they are 'realisations'"):
        InformativeMemory(assimilation(inputs="realisations"), 1)
