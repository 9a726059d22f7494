"""Arguments in a wrong unit, where the physical range is known: refused by name, value, range and what to do."""

import math

import numpy as np
import pytest
from fault_counts import count
from linear_quadratic import LinearQuadratic

from rt_torchrl.envs.cryogenic_tank.disturbances import CyclicLoad
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.disturbances import GaussianGust
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine.disturbances import KaimalWind, RecordedWind
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.envs.wind_turbine.turbsim import WindRecord
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.faulty_system import FaultySystem
from rt_torchrl.systems.operating_limits import OperatingLimits
from rt_torchrl.systems.operating_limits_config import OperatingLimitsConfig
from rt_torchrl.systems.protocols.link import require_timeout
from rt_torchrl.systems.safety import SafetyConfig, SafetyLayer

TURN = 180.0 / math.pi


def limits(plant, **given):
    return lambda: OperatingLimits(plant(), OperatingLimitsConfig(**given))


PLANT = LinearQuadratic()
RECORD = WindRecord(time=np.arange(3.0), speed=np.full(3, 8.0), source="a test")
# The constructor with the value in another unit; the beginning of the message; what the message says of that unit.
WRONG = {
    "km/h for m/s": (lambda: KaimalWind(mean=150.0), "mean=150 m/s of KaimalWind", "1 km/h is 0.278 m/s"),
    "per cent": (lambda: KaimalWind(intensity=16.0), "intensity=16 - of KaimalWind", "16 % is 0.16"),
    "km for m": (lambda: KaimalWind(length_scale=0.34), "length_scale=0.34 m of KaimalWind", "1 mm is 0.001 m"),
    "mm/s for m/s": (lambda: RecordedWind(records=[RECORD], floor=3000.0), "floor=3000 m/s of RecordedWind", "0.278"),
    "g for kg": (lambda: FlappingWing(mass=3.0), "mass=3 kg of the drone", "1 g is 0.001 kg"),
    "mm for m": (lambda: FlappingWing(target=(5000.0, 5000.0)), "target=5000 m of the drone", "1 mm is 0.001 m"),
    "rad/s of the stroke plane": (
        lambda: FlappingWing(stroke_plane_rate=1000.0 / TURN),
        "stroke_plane_rate=17.4533 deg/s of the drone",
        "1 rad/s is 57.3 deg/s",
    ),
    "ms for s": (lambda: FlappingWing(dt=0.5, horizon=5.0), "dt=0.5 s does not resolve", "dt <= 0.0025 s"),
    "s for ms": (lambda: GaussianGust(time_scale=1e4), "time_scale=10000 s of GaussianGust", "1 ms is 0.001 s"),
    "gusts in km/h": (lambda: GaussianGust(mean=36.0), "mean=36 m/s of GaussianGust", "1 km/h is 0.278 m/s"),
    "kJ for J": (lambda: CryogenicTank(wall_heat_capacity=500.0), "heat capacity 500 J/K", "wall='exponential'"),
    "h for s": (lambda: CyclicLoad(period=1.5), "period=1.5 s of CyclicLoad", "1 h is 3600 s"),
    "mW for W": (lambda: CyclicLoad(peak=250e3), "peak=250000 W of CyclicLoad", "1 mW is 0.001 W"),
    "deg for rad": (
        limits(Pendulum, states={"angle": (-90.0, 90.0)}),
        "limits.states angle=-90 rad of the plant must lie in -3.14159 to 3.14159 rad",
        "1 deg is 0.0175 rad",
    ),
    "rpm for rad/s": (
        limits(Pendulum, states={"angular_speed": (-60.0, 60.0)}),
        "limits.states angular_speed=-60 rad/s",
        "1 rpm is 0.105 rad/s",
    ),
    "kPa of a limit": (
        limits(CryogenicTank, states={"pressure": (300.0, 700.0)}),
        "limits.states pressure=300 Pa of the plant must lie in 80000 to 900000 Pa",
        "1 kPa is 1000 Pa",
    ),
    "N m for kN m": (
        limits(WindTurbine, actions={"generator_torque": (0.0, 43e6)}),
        "limits.actions generator_torque=4.3e+07 N m of the plant must lie in 0 to 43093.6 N m",
        "1 kN m is 1000 N m",
    ),
    "a rate per minute": (
        limits(WindTurbine, rates={"blade_pitch": 480.0}),
        "limits.rates blade_pitch=480 deg/s of the plant must lie in 0 to 60 deg/s",
        "1 rad/s is 57.3 deg/s",
    ),
    "interval in ms": (
        lambda: SafetyLayer(PlantEnv(PLANT), SafetyConfig(interval=100.0), fallback=(0.0,)),
        "interval=100.0 s must be the control interval of plant 'linear_quadratic', 0.1 s",
        "1 ms is 0.001 s",
    ),
    "interval of faults": (
        lambda: FaultySystem(PlantEnv(PLANT), [], interval=100.0),
        "interval=100.0 s must be the control interval",
        "1 ms is 0.001 s",
    ),
    "timeout in ms": (lambda: require_timeout(400.0), "timeout=400 s of the link", "1 ms is 0.001 s"),
}


def require_refused(case):
    make, said, remedy = WRONG[case]
    with pytest.raises(ValueError, match=r".") as raised:
        make()
    assert str(raised.value).startswith(said) or said in str(raised.value)
    assert remedy in str(raised.value)


@pytest.mark.parametrize("case", WRONG)
def test_an_argument_in_a_wrong_unit_is_refused(case):
    require_refused(case)


@pytest.mark.faults
def test_arguments_in_wrong_units_are_refused_and_counted():
    for case in WRONG:
        require_refused(case)
        count("arguments in a wrong unit", "refused")


def test_what_is_right_is_taken():
    FlappingWing(mass=3.5e-3, stroke_plane_rate=400.0)
    limits(Pendulum, states={"angle": (-math.pi / 2, math.inf)}, rates={"torque": 40.0})()
