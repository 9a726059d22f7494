"""The drone's figures against the numbers they are drawn from, on a short flight."""

import numpy as np
import pytest
import torch
from figure_reading import line, panel, snapshot_of

from rt_torchrl.envs.flapping_wing import figures
from rt_torchrl.envs.flapping_wing.closures import QuasiSteadyPolar
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.figures.snapshot import Snapshot


@pytest.fixture(scope="module")
def snapshot() -> Snapshot:
    """Four beats of the real drone, and of a twin that has half the lift."""
    twin = QuasiSteadyPolar(torch.tensor([0.86, 0.05, 1.5], dtype=torch.float64))
    return snapshot_of(FlappingWing(horizon=0.2), twin, shift=0.1, realisations=False)


def same(line, values) -> bool:
    return np.array_equal(line.get_ydata(), values.numpy())


def test_collectors_path_is_the_record(snapshot):
    figure = figures.flight_path(snapshot)
    plant, real = snapshot.plant, snapshot.record.states
    path, wind, distance = (panel(figure, name) for name in ("vertical plane", *_side_labels(plant)))
    for name, states in (("real", real), ("twin", snapshot.replay)):
        assert np.array_equal(line(path, name).get_xydata(), states[:, :2].numpy())
        away = torch.hypot(states[:, 0] - 5.0, states[:, 1] - 5.0)
        np.testing.assert_allclose(line(distance, name).get_ydata(), away.numpy(), rtol=1e-14)
    assert line(path, "target").get_xydata().tolist() == [[5.0, 5.0]]
    assert (path.get_xlabel(), path.get_ylabel()) == (plant.states[0].label, plant.states[1].label)
    assert path.get_aspect() == 1.0
    assert same(line(wind, "recorded"), snapshot.record.exogenous[:, 0])
    assert same(line(wind, "large scale (SVR)"), snapshot.large_scale[:, 0])
    assert 2.554 in [entry.get_ydata()[0] for entry in wind.lines]
    assert distance.get_xlabel() == "time [s]"


def _side_labels(plant):
    return plant.inputs[0].label, "distance to the target [m]"


def test_polars_are_those_of_the_closures(snapshot):
    figure = figures.polars(snapshot)
    lift, drag, share = figure.axes
    angle = line(lift, "true").get_xdata()
    alpha = np.radians(angle)
    laws = {"true": (1.71, 0.043, 1.595), "twin": (0.86, 0.05, 1.5)}
    laws["initial twin"] = snapshot.initial_closure.coefficients.tolist()
    for name, (a, b, c) in laws.items():
        # Curves of order one, exact to rounding.
        np.testing.assert_allclose(line(lift, name).get_ydata(), a * np.sin(2 * alpha), atol=1e-13)
        np.testing.assert_allclose(line(drag, name).get_ydata(), b + c * (1 - np.cos(2 * alpha)), atol=1e-13)
    assert "twin: a = 0.86, b = 0.05, c = 1.5" in figure._suptitle.get_text()
    assert sum(bar.get_height() for bar in share.patches) == pytest.approx(100.0, rel=1e-9)
    assert [ax.get_title(loc="left")[-3:] for ax in (lift, drag)] == ["[-]", "[-]"]
    assert share.get_xlabel().endswith("[deg]")


def test_control_surfaces_are_the_policies_with_the_other_errors_at_zero(snapshot):
    figure = figures.control_surfaces(snapshot)
    contours = [ax for ax in figure.axes if ax.get_title(loc="left") in ("model-based", "model-free")]
    assert len(contours) == 8
    planes = {(ax.get_xlabel(), ax.get_ylabel()) for ax in contours if ax.get_ylabel()}
    e_x, e_z, de_x, de_z = (signal.label for signal in snapshot.plant.observations)
    assert planes == {(e_x, de_x), (e_z, de_z)}
    for ax in contours:
        k = contours.index(ax) % 4 // 2
        policy = snapshot.policies[ax.get_title(loc="left").replace("-", "_")]
        filled, observation = ax.collections[0], torch.zeros(4, dtype=torch.float64)
        plane = [0, 2] if ax.get_xlabel() == e_x else [1, 3]
        corner = [ax.get_xlim()[0], ax.get_ylim()[1]]
        observation[plane] = torch.tensor(corner, dtype=torch.float64)
        value = policy(observation)[k].item()
        level = np.searchsorted(filled.levels, value) - 1
        # The corner is a vertex of the band that holds its value.
        distance = np.linalg.norm(filled.get_paths()[level].vertices - corner, axis=1)
        assert distance.min() < 1e-9
