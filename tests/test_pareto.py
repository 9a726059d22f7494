"""The front of a plant's quantities over a weight of its cost."""

import dataclasses
import json

import pytest
from test_export_recipe import RECIPES, recipe

from rt_torchrl.study.pareto import Effort, pareto_front

SMALL = Effort(planned_on=3, unseen=3, starts=1, approach=40, iterations=40)
SHORT = ("--horizon", "30", "--policy", "bias", "--observe", "measured", "--task", "engineering")


def turbine(*values):
    return pareto_front(RECIPES / "wind_turbine.py", SHORT, "engineering.pitch-rate", values, SMALL)


def test_dearer_pitch_travels_less_and_lets_the_rotor_run_faster():
    points = list(turbine(0.01, 10.0))
    travel, speed, power = (
        [point.merit[name] for point in points]
        for name in ("pitch travel [deg/s]", "speed above rated [rad/s]", "mean power [MW]")
    )
    assert [point.weight for point in points] == [0.01, 10.0]
    assert travel[1] < 0.7 * travel[0] and speed[1] > speed[0] and min(power) > 1.0
    assert points[0].cost < points[1].cost


@pytest.mark.parametrize("values", [(0.1,), (0.1, 0.1), (0.1, -1.0), (0.1, float("nan"))])
def test_impossible_values_are_refused_before_any_work(values):
    with pytest.raises(ValueError, match=r"values=.*engineering\.pitch-rate must be"):
        turbine(*values)


@pytest.mark.parametrize("name", ["planned_on", "unseen", "starts", "approach", "iterations"])
def test_impossible_efforts_are_refused(name):
    with pytest.raises(ValueError, match=f"{name}=-1 must be at least"):
        dataclasses.replace(SMALL, **{name: -1})


def test_the_recipe_keeps_table_and_figure(tmp_path, capsys, monkeypatch):
    made = recipe("pareto")
    front = made.FRONTS["cryogenic_tank"]
    short = dataclasses.replace(front, options=(*front.options, "--horizon", "39990"), effort=SMALL)
    monkeypatch.setitem(made.FRONTS, "cryogenic_tank", short)
    made.main(made.Config(plant="cryogenic_tank", values=(500.0, 50e3), log_dir=tmp_path / "new"))
    found = json.loads((tmp_path / "new" / "cryogenic_tank.json").read_text())
    mass = [point["merit"]["vented mass [kg]"] for point in found["front"]]
    assert mass[1] < mass[0] and set(found["classical"]) == {"on-off", "PI"}
    assert (tmp_path / "new" / "cryogenic_tank.png").stat().st_size > 5000
    assert "late pressure error [kPa]" in capsys.readouterr().out


def test_weights_of_another_task_are_refused():
    made = recipe("wind_turbine")
    weights = made.EngineeringCost(pitch_rate=0.1)
    assert made.Config(task="engineering", engineering=weights).plant().cost == weights
    with pytest.raises(ValueError, match="weights of the task engineering"):
        made.Config(engineering=weights)
