"""The cascaded tanks: balances of the plant, and the recipe on a synthetic record of the tests' own."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from test_export_recipe import recipe
from torch import nn

from rt_torchrl.envs.cascaded_tanks.closures import Hydraulics, NeuralHydraulics
from rt_torchrl.envs.cascaded_tanks.plant import CascadedTanks
from rt_torchrl.envs.cascaded_tanks.record import read_benchmark
from rt_torchrl.trajectories.rollout import Rollout


class ThroughATube(nn.Module):
    """Both tanks drain in proportion to their levels: a linear system with a closed form."""

    def forward(self, features):
        upper, lower, voltage = features.unbind(-1)
        return torch.stack([0.05 * voltage - 0.01 * upper, 0.01 * upper - 0.02 * lower], -1)


def test_linear_tanks_follow_their_closed_form():
    plant = CascadedTanks(horizon=400.0, closure=ThroughATube())
    start, n = torch.tensor([[8.0, 5.0]]).double(), plant.n_steps
    inputs = torch.full((1, n, 1), 5.0).double()
    with torch.no_grad():
        states = Rollout(plant, plant.closure)(start, inputs, torch.full((1, n, 1), 2.0).double()).states[0]
    t = 4.0 * np.arange(n + 1)
    # h_1 → 10 with the rate 0.01/s, and h_2 follows with 0.02/s; the edge at 10 V is some 5 V away.
    upper = 10.0 - 2.0 * np.exp(-0.01 * t)
    lower = 5.0 - 2.0 * np.exp(-0.01 * t) + 2.0 * np.exp(-0.02 * t)
    np.testing.assert_allclose(states[:, 0].numpy(), upper, atol=1e-8)  # Runge-Kutta with 4 s: (0.08)⁵/120 a step
    np.testing.assert_allclose(states[:, 1].numpy(), lower, atol=1e-7)


def test_water_is_lost_at_the_edges_alone():
    law, plant = Hydraulics.true(), CascadedTanks()
    pump, down, out, over = law.flows(torch.tensor([10.0, 4.0, 2.0]).double())
    c = law.named_coefficients()
    assert pump.item() == pytest.approx(2.0 * c["pump"].item()) and over.item() < 1e-12
    assert down.item() == pytest.approx(10.0 * c["upper_outlet"].item())
    assert out.item() == pytest.approx(2.0 * c["lower_outlet"].item() - 4.0 * c["lower_loss"].item(), rel=1e-5)
    over_the_edge = torch.tensor([c["overflow_level"].item() + 2.0, 4.0, 6.0]).double()
    rates, (_, down, out, over) = law(over_the_edge), law.flows(over_the_edge)
    assert over.item() == pytest.approx(0.5, abs=1e-6)  # 2 V above the edge at 0.25/s
    assert rates[1].item() == pytest.approx((down + c["overflow_share"] * over - out).item())
    state, action, set_point = (torch.tensor(values).double() for values in ([0.0, 12.0], [0.0], [5.0]))
    full = plant.vector_field(torch.tensor(0.0), state, action, set_point, ThroughATube())
    assert full[1].item() == pytest.approx(-0.02 * 12.0 - 0.25 * 2.0, abs=1e-6)


def test_a_perceptron_moves_water_and_makes_none_in_between():
    closure = NeuralHydraulics(Hydraulics.true(), hidden=(3,), generator=torch.Generator().manual_seed(0))
    features = torch.tensor([[15.0, 5.0, 3.0], [28.0, 9.0, 6.0]]).double()
    torch.testing.assert_close(closure(features), closure.law(features), rtol=0, atol=0)
    with torch.no_grad():
        closure.correction.network[-1].bias.copy_(torch.tensor([0.4, 0.0]))
    change = closure(features) - closure.law(features)
    torch.testing.assert_close(change.sum(-1), torch.zeros(2).double())  # what leaves one tank reaches the other
    assert (change[:, 1] > 0.0).all()


def synthetic(path, *, samples=420, noise=0.02):
    """A record of tanks whose hydraulics nobody has told the recipe, as the benchmark's file has it."""
    plant, generator, columns = CascadedTanks(), torch.Generator().manual_seed(5), {}
    truth = Hydraulics(torch.tensor([0.055, 0.007, 0.09, 0.008, 24.0, 0.7]))
    for name in ("Est", "Val"):
        steps = torch.rand(1, samples // 25 + 1, 1, generator=generator, dtype=torch.float64)
        voltage = (0.5 + 5.5 * steps).repeat_interleave(25, 1)[:, :samples]
        with torch.no_grad():
            start, inputs = torch.tensor([[18.0, 5.0]]).double(), torch.full_like(voltage, 5.0)
            level = Rollout(plant, truth)(start, inputs, voltage).states[0, :-1, 1].clamp(max=10.0)
        columns[f"u{name}"] = voltage[0, :, 0].numpy()
        columns[f"y{name}"] = (level + noise * torch.randn(samples, generator=generator).double()).numpy()
    names = ["uEst", "uVal", "yEst", "yVal"]
    header = ",".join(f'"{name}"' for name in names) + ',"Ts",'
    rows = np.stack([columns[name] for name in names], -1)
    path.write_text(header + "\n" + "".join(",".join(f"{x:.6f}" for x in row) + ",,\n" for row in rows))
    return columns


@pytest.mark.slow
def test_the_recipe_identifies_a_synthetic_record(tmp_path, capsys):
    made, options = recipe("cascaded_tanks"), {"folds": 2, "priors": (1000.0,), "starts": 2, "iterations": 20}
    synthetic(tmp_path / "data.csv")
    made.main(made.Config(data=tmp_path / "data.csv", log_dir=tmp_path / "results", **options, test=True))
    found = json.loads((tmp_path / "results" / "results.json").read_text())
    # What is left of the physics, which is the right one, is the sensor's noise of 20 mV.
    assert found["physics"]["test"]["rms"] < 0.03
    # A fold knows half of a short record, with two or three overflows.
    assert found["folds"]["physics"] < 0.15
    assert found["physics and perceptron"]["test"]["rms"] < 0.05
    low, high = found["physics"]["intervals"]["pump"]
    assert low - 0.002 < 0.055 < high + 0.002
    figures = {path.name for path in (tmp_path / "results").glob("*.png")}
    assert figures == {f"{which}_{name}.png" for which in ("estimation", "test") for name in ("physics", "perceptron")}


def test_the_record_is_read_from_a_file_or_the_package(tmp_path, monkeypatch):
    columns = synthetic(tmp_path / "data.csv", samples=30)
    read = read_benchmark(tmp_path / "data.csv")
    for part, name in zip((*read["estimation"], *read["test"]), ("uEst", "yEst", "uVal", "yVal"), strict=True):
        np.testing.assert_allclose(part, columns[name], atol=1e-6)
    package = pytest.importorskip("nonlinear_benchmarks")
    parts = [SimpleNamespace(u=columns[f"u{name}"], y=columns[f"y{name}"]) for name in ("Est", "Val")]
    monkeypatch.setattr(package, "Cascaded_Tanks", lambda: parts)
    np.testing.assert_array_equal(read_benchmark(None)["test"][1], columns["yVal"])


def test_every_part_of_a_record_is_held_out_once():
    made = recipe("cascaded_tanks")
    record = made.sensor_record_of(np.linspace(1.0, 2.0, 401), np.linspace(3.0, 5.0, 401))
    parts = list(made.folds_of(record, 4))
    assert [len(held_out.actions) for _, held_out in parts] == [100] * 4
    assert [len(training) for training, _ in parts] == [1, 2, 2, 1]
    assert parts[1][1].start == 400.0 and parts[1][1].guess[1] == record.readings[100, 0]
