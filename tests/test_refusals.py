"""Every argument that cannot be is refused in words, by ``data/refusals.txt``: its name, its value, what is allowed."""

# ruff: noqa: F401  (expressions of the table read the names)

import dataclasses
import importlib
import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
import study
import torch
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic
from seeds_and_numbers import double, seeded
from small_runs import small_run
from tensordict import TensorDict
from test_classical import PD
from test_hypotheses import Suspecting
from test_protocols import LEARNERS, PLANNERS, algorithm
from test_real_system import WIND, Rig, connected
from test_study import TINY, leave
from torch import nn
from traced_function import sections

import rt_torchrl as rt
from rt_torchrl.contract.check import require_controller
from rt_torchrl.envs.cryogenic_tank import unknown as tanks
from rt_torchrl.envs.wind_turbine import unknown as turbines
from rt_torchrl.envs.wind_turbine.turbsim import WindRecord
from rt_torchrl.fit.log import Column, SensorLog, checked, read_log
from rt_torchrl.runs.command_line import from_command_line
from rt_torchrl.runs.settings import module_of

MODULES = """
    control.command_cost control.forecasts control.predictive_control evaluation.optimum
    envs.cascaded_tanks.record envs.cryogenic_tank.closures envs.cryogenic_tank.disturbances envs.cryogenic_tank.plant
    envs.cryogenic_tank.unknown envs.flapping_wing.closures
    envs.flapping_wing.disturbances envs.flapping_wing.plant envs.pendulum.plant envs.pendulum.real
    envs.wind_turbine.closures envs.wind_turbine.disturbances envs.wind_turbine.plant envs.wind_turbine.rosco
    envs.wind_turbine.rotor envs.wind_turbine.turbsim envs.wind_turbine.unknown fit.least_squares fit.log
    fit.resampling plants.signal runs.metrics steps.assimilate steps.config steps.interact steps.hypotheses.ensemble
    steps.learn steps.losses steps.memory steps.plan systems.config systems.exploration systems.operation
    systems.safety
""".split()
"""Modules of the library whose names expressions may use beside the public ones."""
RECIPES = Path(__file__).parent.parent / "recipes"
ROWS = [row for section in sections("refusals.txt").values() for row in section.values()]
LQ = LinearQuadratic()
LAM, BETA, FLAT = np.array([2.0, 3.0, 3.5, 5.0, 7.5, 8.0]), np.array([-2.0, 0.0, 0.5, 4.0, 9.0]), np.zeros((6, 5))


class Stepping(LinearQuadratic):
    def step(self, t, state, command, exogenous, closure):
        return super().step(t, state, command, exogenous, closure)


def zeros(*shape):
    return torch.zeros(shape, dtype=torch.float64)


def text(content, name="table.csv"):
    path = Path(tempfile.mkdtemp(), name)
    path.write_text(content, encoding="utf-8")
    return path


def recipe(name, **options):
    """The configuration of a recipe."""
    return module_of(RECIPES / f"{name}.py").Config(**options)


def options_file(content):
    """The turbine's configuration by a file."""
    arguments = ["--config", str(text(content, "config.json"))]
    return from_command_line(module_of(RECIPES / "wind_turbine.py").Config, arguments)


TABLE = "t,x_mm,velocity,force,disturbance,note\n0,1000,0.1,1,0,a\n100,2000,0.2,1,0,b\n250,3000,0.3,-1,0.5,c\n"


def log(table, *columns):
    return checked(read_log(text(table), LQ, [Column.parse(column) for column in columns]), LQ)


REGULAR = SensorLog(
    times=0.1 * np.arange(50), columns=dict.fromkeys(("position", "velocity", "force", "disturbance"), np.zeros(50))
)


def run(**options):
    """A run on the oracle plant, in a folder that does not exist yet."""
    return small_run(Path(tempfile.mkdtemp(), "run"), **options)


def pair(**options):
    """A finished run, and another one with these options."""
    usual = {"seed": 0, "costs": [1.0, 2.0]}
    return [leave(Path(tempfile.mkdtemp(), "run"), **usual | one) for one in ({}, options)]


def studied(**options):
    usual = {"systems": (f"tiny={TINY}",), "arms": ("twinning",), "log_dir": Path(tempfile.mkdtemp())}
    study.studied(study.Config(**usual | options))


def modbus(**options):
    client = pytest.importorskip("pymodbus.client").ModbusTcpClient("127.0.0.1", **options)
    return rt.ModbusLink(client, {"a": rt.Register(0)}, {"b": rt.Register(4)})


def law(method=PD.law, **own):
    """A PD law with other methods, as the first controller of a run."""
    return require_controller("first", type("Mine", (PD,), {"law": method, **own}), LQ)


def still(**options):
    """A real system of which nothing may move before it fits."""
    rig = Rig(LQ)
    rig._reset = rig._step = None
    return connected(LQ, rig=rig, **options)


def client(entries=None, commands=("command.force",), **options):
    entries = {"state": ("position", "velocity")} if entries is None else entries
    return rt.ConnectedPlant(None, entries, commands, LQ.actions, **{"period": 0.1} | options)


def RECEDING(seconds):
    return rt.PlannerConfig(method="receding_horizon", receding_horizon=rt.PredictiveConfig(horizon=seconds))


MPC = rt.PredictiveControl(LQ, LQ.closure, rt.PredictiveConfig(horizon=1.0))


def wind_record(time, speed):
    return WindRecord(np.asarray(time, dtype=float), np.asarray(speed, dtype=float), "r.hh")


def ramp(duration):
    return wind_record(np.arange(duration + 1), 5.0 + 0.0 * np.arange(duration + 1))


def horizon(**options):
    return rt.RecedingHorizon(LQ, LQ.closure, rt.PredictiveConfig(**options))


def flight(*, policy=None, state=(2, 2), exogenous=(2, 50, 1), command=(2, 50, 1), spoil=None, **options):
    values = {"initial_state": zeros(*state), "exogenous": zeros(*exogenous)}
    values |= {} if command is None else {"command": zeros(*command)}
    if spoil:
        values[spoil].flatten()[3] = math.nan
    return rt.Rollout(LQ, LQ.closure, policy, **options)(**values)


class Names(dict):
    """The names of this file, and all of the library by need."""

    def __missing__(self, name):
        for module in (rt, *(importlib.import_module(f"rt_torchrl.{one}") for one in MODULES)):
            if hasattr(module, name):
                return getattr(module, name)
        raise KeyError(name)


HERE = Names(globals())
LAGGED = HERE["LAGGED"] = rt.LaggedActuator(LQ, "force", 0.4)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.parts[0])
def test_it_is_refused(row, unchecked):
    with pytest.raises(ValueError, match=row.word):
        eval(row.parts[0], {}, HERE)
