"""Figures of every plant within their canvas, and animations against the numbers they are drawn from."""

import math

import numpy as np
import pytest
import torch
from figure_reading import clipped_texts, collisions, draw, snapshot_of
from PIL import Image

from rt_torchrl.envs.cryogenic_tank import figures as tank
from rt_torchrl.envs.cryogenic_tank.closures import ConstantCoefficients
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing import figures as drone
from rt_torchrl.envs.flapping_wing.closures import QuasiSteadyPolar
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.wind_turbine import figures as turbine
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.figures.animation import FRAMES, RATE, shown_samples


@pytest.fixture(scope="module")
def blowing():
    plant = WindTurbine(horizon=10.0)
    return snapshot_of(plant, plant.make_closure(torch.Generator().manual_seed(0)), shift=0.1)


@pytest.fixture(scope="module")
def boiling():
    episodes = [{"closure": {"U_s": 46.0, "U_HX": 70.0, "K_JT": 480e9}}] * 2
    return snapshot_of(CryogenicTank(horizon=600.0), ConstantCoefficients.true(), shift=1.0, episodes=episodes)


@pytest.fixture(scope="module")
def flying():
    return snapshot_of(FlappingWing(horizon=0.2), QuasiSteadyPolar.true(), shift=0.1, realisations=False)


@pytest.mark.parametrize(
    ("figures", "snapshot", "names"),
    [
        (turbine, "blowing", {"power_and_speed", "power_coefficient", "scatter"}),
        (tank, "boiling", {"tank", "heat_exchanger", "closure_weights"}),
        (drone, "flying", {"flight_path", "flight", "polars", "control_surfaces"}),
    ],
)
def test_every_figure_of_a_plant_is_drawn_within_its_canvas(figures, snapshot, names, request):
    drawn = figures.figures_of(request.getfixturevalue(snapshot))
    assert set(drawn) == names
    for name, figure in drawn.items():
        assert draw(figure)
        assert clipped_texts(figure) == [] and not collisions(figure), name


@pytest.mark.parametrize(
    ("scene", "snapshot", "frames"),
    [
        (turbine, "blowing", 20),
        (tank, "boiling", 20),
        pytest.param(drone, "flying", FRAMES, marks=pytest.mark.slow),
    ],
)
def test_it_has_a_frame_for_each_interval_up_to_the_greatest_number(scene, snapshot, frames, tmp_path, request):
    path = scene.scene(request.getfixturevalue(snapshot)).save(tmp_path / "last.gif")
    with Image.open(path) as animation:
        assert animation.n_frames == frames and animation.info["duration"] == 1000 / RATE
        first = np.asarray(animation.convert("RGB"))
        animation.seek(frames - 1)
        assert (np.asarray(animation.convert("RGB")) != first).any()
    assert path.stat().st_size < 3_000_000


def test_the_rotor_shows_wind_and_pitch_and_turns_with_its_speed(blowing):
    scene, record = turbine.scene(blowing), blowing.record
    angles = []
    for k in (7, 8):
        scene.show(k)
        _, *blades = scene.ax.patches  # the first one is the tower
        tip = blades[0].get_xy()[2:4].mean(0) - [0.0, turbine.HUB]
        assert math.hypot(*tip) == pytest.approx(turbine.TIP)
        angles.append(math.atan2(*tip))
    speed = record.states[8, 0].item() / WindTurbine.rated_rotor_speed
    assert abs(angles[1] - angles[0]) == pytest.approx(math.radians(turbine.TURN * speed))
    texts = [text.get_text() for text in scene.ax.texts]
    assert texts == [f"wind {record.exogenous[8, 0]:.1f} m/s", "time 4.0 s", f"pitch {record.actions[8, 1]:.1f} deg"]
    speeds = scene.figure.axes[2].lines
    assert np.array_equal(speeds[1].get_ydata(), 97.0 * record.states[:-1, 0].numpy())
    assert speeds[2].get_xdata() == [4.0, 4.0]


def test_the_level_is_that_of_a_sphere(boiling):
    for height in (-1.0, -0.3, 0.0, 0.5, 1.0):
        assert tank.level(0.25 * (1.0 + height) ** 2 * (2.0 - height)) == pytest.approx(height, abs=1e-4)
    scene = tank.scene(boiling)
    scene.show(5)
    surface = scene.ax.patches[0].get_xy()[:, 1].max()
    assert surface == pytest.approx(tank.level(boiling.record.states[5, 1].item() / 60.0), abs=1e-9)
    assert f"load {boiling.record.exogenous[5, 0]:.0f} W" in scene.ax.texts[0].get_text()


def test_frames_are_spread_over_the_samples():
    assert shown_samples(3) == [0, 1, 2]
    many = shown_samples(1200)
    assert len(many) == 125 and many[0] == 0 and many[-1] == 1199


def test_another_format_is_refused(blowing, tmp_path):
    with pytest.raises(ValueError, match=r"must end in '\.gif'"):
        turbine.scene(blowing).save(tmp_path / "last.mp4")
