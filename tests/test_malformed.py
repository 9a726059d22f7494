"""Files, options and units of others: refused in words, or sound; never accepted in silence."""

import dataclasses
import math
import typing
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from fault_counts import count
from faulty_system import FaultySystem, Injection
from hypothesis import HealthCheck, given, settings
from linear_quadratic import LinearQuadratic
from malformed_files import GOOD, READERS, damaged, outcome
from torchrl.data import Bounded

import rt_torchrl
from rt_torchrl import (
    Actuation,
    LimitConfig,
    PlantEnv,
    Reading,
    SafetyConfig,
    SafetyLayer,
    Signal,
    TwinningConfig,
)
from rt_torchrl.control.predictive_control import PredictiveConfig
from rt_torchrl.envs.cryogenic_tank.disturbances import CyclicLoad
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.disturbances import GaussianGust
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine.disturbances import KaimalWind, RecordedWind
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.envs.wind_turbine.rotor import PowerCoefficientTable
from rt_torchrl.envs.wind_turbine.turbsim import WindRecord
from rt_torchrl.fit.log import Column, SensorLog
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.systems.config import OperatingLimitsConfig
from rt_torchrl.systems.safety import ActionLimits, OperatingLimits

NUMBERS = (math.nan, math.inf, -math.inf, -1, 0, -1e308, 1e308, 2.5)
OTHERS = ("x", "", None, [], {}, True, (1.0, 2.0, 3.0), object())
TIMES = (
    "interval",
    "deadline",
    "hold",
    "patience",
    "correlation_time",
    "gap",
    "period",
    "dt",
    "horizon",
    "clock_tolerance",
)
"""Arguments in seconds, which are never negative."""


class Case(typing.NamedTuple):
    """One constructor with good arguments, and the one that is replaced."""

    make: typing.Callable
    good: dict
    argument: str
    value: object

    def __repr__(self):
        return f"{getattr(self.make, '__name__', self.make)}({self.argument}={self.value!r})"

    def wrong(self, kind):
        """Whether no constructor should take this value; what else is accepted may be meant."""
        if isinstance(self.value, float) and math.isnan(self.value):
            return True
        if self.argument in TIMES and isinstance(self.value, int | float) and self.value < 0:
            return True
        return kind in (int, float) and (isinstance(self.value, str | bool | list | dict) or type(self.value) is object)


def configurations():
    """Every public configuration, with the default of every option."""
    for name in dir(rt_torchrl):
        found = getattr(rt_torchrl, name)
        if isinstance(found, type) and dataclasses.is_dataclass(found) and name.endswith("Config"):
            yield found
    yield TwinningConfig


GOOD_OPTIONS = {
    SafetyConfig: {"interval": 0.1},
    LimitConfig: {"starts": {}},
    PredictiveConfig: {"horizon": 2.0},
    RunConfig: {},
    Injection: {"kind": "nan"},
    Column: {"header": "a", "signal": "b"},
}
STATES = {"times": np.arange(5.0), "columns": {"x": np.zeros(5)}}
TABLE = {"tip_speed_ratio": np.arange(1.0, 6.0), "pitch": np.arange(5.0), "values": np.full((5, 5), 0.1)}
SPEC = Bounded(low=-2.0, high=2.0, shape=(1,), dtype=torch.float64)
CONSTRUCTORS = [
    (LinearQuadratic, {"dt": 0.1, "horizon": 2.0}),
    (WindTurbine, {"dt": 0.05, "horizon": 10.0}),
    (FlappingWing, {"dt": 0.001, "horizon": 0.1}),
    (CryogenicTank, {"dt": 30.0, "horizon": 3000.0}),
    (Pendulum, {"dt": 0.05, "horizon": 2.0}),
    (lambda **o: PlantEnv(LinearQuadratic(horizon=2.0), **o), {"batch_size": 1, "noise": 0.1, "seed": 0}),
    (lambda **o: SafetyLayer(PlantEnv(LinearQuadratic()), SafetyConfig(interval=0.1), **o), {"fallback": (0.0,)}),
    (Reading, {"scale": 1.0, "offset": 0.0}),
    (Actuation, {"scale": 1.0, "offset": 0.0}),
    (lambda **o: Signal(symbol="x", name="x", unit="m", **o), {"low": -1.0, "high": 1.0}),
    (lambda **o: SafetyConfig(interval=0.1, **o), {"deadline": 1.0, "hold": 1.0, "patience": 1.0}),
    (
        lambda **o: ActionLimits(SPEC, SafetyConfig(**o)),
        {"interval": 0.1, "low": (-1.0,), "high": (1.0,), "rates": (1.0,)},
    ),
    (SensorLog, STATES),
    (PowerCoefficientTable, TABLE),
    (lambda **o: WindRecord(source="test", **o), {"time": np.arange(5.0), "speed": np.full(5, 8.0)}),
]


def spoilt(good):
    """Wrong values in the place of a good one."""
    if isinstance(good, np.ndarray):
        flat = [good.copy().astype(float) for _ in range(5)]
        for array, value in zip(flat, (math.nan, math.inf, -math.inf, -1e308, 1e308), strict=True):
            array.flat[good.size // 2] = value
        return [*flat, good[..., None], good[:1], good[:0], good.astype(str), good.astype(object), "x", None, [], 3.0]
    if isinstance(good, tuple) and good and isinstance(good[0], float):
        tuples = [(value, *good[1:]) for value in NUMBERS]
        return [*tuples, (), (*good, *good), ("x",), (None,), "x", 3.0, object()]
    return [*NUMBERS, *OTHERS]


def cases():
    """All cases with the declared type of the argument, in a fixed order."""
    for config in dict.fromkeys((*configurations(), *GOOD_OPTIONS)):
        kinds = typing.get_type_hints(config)
        for field in dataclasses.fields(config):
            kind = kinds[field.name]
            if dataclasses.is_dataclass(kind) or kind is Path or typing.get_origin(kind) in (Mapping, Sequence):
                continue
            good = GOOD_OPTIONS.get(config, {}).get(field.name, getattr(config, field.name, None))
            for value in spoilt(good):
                yield Case(config, GOOD_OPTIONS.get(config, {}), field.name, value), kind
    for make, good in CONSTRUCTORS:
        for argument, value in good.items():
            for bad in spoilt(value):
                yield Case(make, good, argument, bad), type(value)


def option_outcome(case, kind):
    """What becomes of a case: refused, accepted, wrong (accepted), unnamed (refused without its name), or raw."""
    try:
        case.make(**case.good | {case.argument: case.value})
    except ValueError as error:
        words = {"times": ("time", "log"), "columns": ("column",)}.get(case.argument, case.argument.split("_"))
        return "refused" if any(word in str(error) for word in (case.argument, *words)) else f"unnamed: {error}"
    except Exception as error:
        return f"raw: {type(error).__name__}: {error}"
    return "wrong" if case.wrong(kind) else "accepted"


# Files and options of others: refused in words, or sound; never a raw error, never accepted in silence.


FEW, MANY = 5, 150
SHARED = {"derandomize": True, "deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}


def require_words_or_soundness(name, folder, examples):
    found = outcome(name, GOOD[name], folder)
    assert found == "sound"

    @settings(max_examples=examples, **SHARED)
    @given(file=damaged(name))
    def tried(file):
        found = outcome(name, file, folder)
        count(f"malformed files: {name}", found.split(":")[0], defect=found not in ("refused", "sound"))
        assert found in ("refused", "sound")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        tried()


@pytest.mark.usefixtures("unchecked")  # what stands for an algorithm is none
@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_is_refused_or_sound(name, tmp_path):
    require_words_or_soundness(name, tmp_path, FEW)


@pytest.mark.faults
@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", READERS)
def test_many_damaged_files_are_refused_or_sound(name, tmp_path):
    require_words_or_soundness(name, tmp_path, MANY)


def require_no_defects(every):
    defects = []
    for case, kind in list(cases())[::every]:
        found = option_outcome(case, kind)
        defect = found not in ("refused", "accepted")
        count("constructor and option inputs", found.split(":")[0], defect=defect)
        defects += [f"{case!r}: {found}"] if defect else []
    assert not defects


@pytest.mark.usefixtures("unchecked")
def test_a_wrong_option_is_refused_by_its_name():
    require_no_defects(every=40)


@pytest.mark.faults
@pytest.mark.usefixtures("unchecked")
def test_every_wrong_option_is_refused_by_its_name():
    require_no_defects(every=1)


@pytest.mark.parametrize("compressed", [True, False], ids=["compressed", "overlapping"])
def test_a_file_of_tensors_that_would_grow_is_refused(tmp_path, compressed):
    import zipfile

    path = tmp_path / "weights.pt"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED) as archive:
        archive.writestr("archive/data.pkl", b"\0" * 100_000)
    if not compressed:
        whole = path.read_bytes()
        size = (100_000).to_bytes(4, "little")
        path.write_bytes(whole.replace(size, (2**31).to_bytes(4, "little")))
    with pytest.raises(ValueError, match=r"weights\.pt is damaged, or no file of a run"):
        READERS["weights.pt"].read(path)


# Arguments in a wrong unit, where the physical range is known: refused by name, value, range and what to do.


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
    "kJ for J": (lambda: CryogenicTank(wall_heat_capacity=500.0), "heat capacity 500 J/K", "a heavier wall"),
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
    "timeout in ms": (
        lambda: rt_torchrl.OpcUaLink(None, {}, {}, timeout=400.0),
        "timeout=400 s of the link",
        "1 ms is 0.001 s",
    ),
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
