"""FMUs: their content, what a simulator gets of them, and trainings on one."""

import ctypes
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from c_build import needs_compiler

from rt_torchrl import FMUEnvironment, FMUError, Reading, RealSystem, Rollout, export_policy_fmu, export_twin_fmu
from rt_torchrl.envs.wind_turbine.plant import WindTurbine

fmpy = pytest.importorskip("fmpy")
PLANT = WindTurbine(horizon=20.0)


@pytest.fixture(scope="module")
def turbine(tmp_path_factory):
    """The true turbine as an FMU."""
    path = tmp_path_factory.mktemp("fmu") / "turbine.fmu"
    export_twin_fmu(PLANT.closure, path, PLANT)
    return path


def environment(path, plant=PLANT, **options):
    given = {
        "actions": [f"command.{s.name}" for s in PLANT.actions],
        "outputs": [f"state.{s.name}" for s in PLANT.states],
        "exogenous": ["exogenous.wind_speed"],
    }
    return FMUEnvironment(path, plant, **given | options)


@needs_compiler
def test_a_turbine_in_an_fmu_is_the_plants_own(turbine):
    """As the real system of an episode under random torque and pitch, against the plant's trajectory."""
    names = [f"state.{s.name}" for s in PLANT.states]

    def start(generator):
        return dict(zip(names, PLANT.draw_initial_state(1, generator)[0].tolist(), strict=True))

    real = RealSystem(
        environment(turbine, start=start),
        PLANT,
        state=Reading(keys=("outputs",)),
        exogenous=Reading(keys=("exogenous",)),
        closure=PLANT.closure,
    )
    generator = torch.Generator().manual_seed(3)
    commands = torch.rand(PLANT.n_steps, 2, generator=generator).double() * torch.tensor([4e4, 10.0])
    entries = real.reset()
    states, inputs = [entries["state"]], []
    for command in commands:
        inputs.append(entries["exogenous"])
        entries = real.step(entries.set("action", command[None]))["next"]
        states.append(entries["state"])
        entries = entries.exclude("reward")
    with torch.no_grad():
        expected = Rollout(PLANT, PLANT.closure)(states[0], torch.stack(inputs, 1), commands[None]).states[0]
    # The same arithmetic in C: rounding over forty steps.
    np.testing.assert_allclose(torch.cat(states).numpy(), expected.numpy(), rtol=1e-9, atol=1e-9)
    real.close()


@needs_compiler
def test_a_policy_in_an_fmu_gives_its_own_actions(tmp_path):
    policy = PLANT.make_policy(torch.Generator().manual_seed(0))
    export_policy_fmu(policy, tmp_path / "policy.fmu", PLANT)
    observations = torch.randn(20, 2, generator=torch.Generator().manual_seed(1)).double()
    names = [f"observation.{signal.name}" for signal in PLANT.observations]
    rows = np.array(
        [(0.5 * k, *row) for k, row in enumerate(observations.tolist())],
        dtype=[("time", float), *((name, float) for name in names)],
    )
    found = fmpy.simulate_fmu(
        str(tmp_path / "policy.fmu"),
        stop_time=9.5,
        output_interval=0.5,
        input=rows,
        output=[f"action.{signal.name}" for signal in PLANT.actions],
        validate=True,
    )
    with torch.no_grad():
        expected = policy(observations).numpy()
    actions = np.array([list(row)[1:] for row in found.tolist()])
    # An output of an FMU is read after the step that its inputs were set for.
    np.testing.assert_allclose(actions[1:], expected[:-1], rtol=1e-9)


FUNCTIONS = re.compile(r"fmi2\w+(?=TYPE)")


@needs_compiler
def test_an_fmu_has_every_function_of_the_standard(turbine, tmp_path):
    """By the header of the standard, which FMPy brings; a master may ask for all."""
    folder = Path(fmpy.extract(str(turbine), unzipdir=str(tmp_path / "unpacked")))
    (library,) = (folder / "binaries").glob("*/*")
    header = Path(fmpy.__file__).parent / "c-code" / "fmi2FunctionTypes.h"
    common, exchange = header.read_text(encoding="utf-8").split("Functions for FMI2 for Model Exchange")
    names = set(FUNCTIONS.findall(common + exchange.split("Functions for FMI2 for Co-Simulation")[1]))
    assert len(names) > 30 and all(hasattr(ctypes.CDLL(str(library)), name) for name in names)
    assert fmpy.validation.validate_fmu(str(turbine)) == []
    units = {variable.name: variable.unit for variable in fmpy.read_model_description(str(turbine)).modelVariables}
    assert units["command.generator_torque"] == "N m" and units["state.rotor_speed"] == "rad/s"


SLAVE = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Real

class Barrel(Fmi2Slave):
    def __init__(self, **options):
        super().__init__(**options)
        self.u, self.v, self.h = 0.0, 0.0, 1.0
        for name in "uv":
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        self.register_variable(Real("h", causality=Fmi2Causality.output))

    def do_step(self, t, dt):
        if self.u > 40000.0:
            raise ValueError("the barrel bursts")
        self.h += dt * (1e-4 * self.u - 0.1 * self.h)
        return True
"""


def test_an_fmu_of_somebody_else_is_stepped_and_its_errors_are_named(tmp_path):
    pytest.importorskip("pythonfmu")
    from pythonfmu.builder import FmuBuilder

    (tmp_path / "barrel.py").write_text(SLAVE)
    path = Path(FmuBuilder.build_FMU(tmp_path / "barrel.py", dest=tmp_path))
    made = environment(path, actions=["u", "v"], outputs=["h"], exogenous=[])
    entries, level = made.reset(), 1.0
    assert entries["outputs"].tolist() == [1.0]
    for _ in range(5):
        entries = made.step(entries.set("action", torch.tensor([1000.0, 0.0]).double()))["next"]
        level += 0.5 * (0.1 - 0.1 * level)
        assert entries["outputs"].item() == pytest.approx(level, abs=1e-12)
        entries = entries.exclude("reward")
    with pytest.raises(FMUError, match=r"the FMU Barrel.fmu refuses a call at t = 2.5 s: fmi2DoStep"):
        made.step(entries.set("action", torch.tensor([41000.0, 0.0]).double()))
    assert made.reset()["outputs"].tolist() == [1.0]
    made.close()


class Recorded:
    """An FMU whose steps return a status, and what is called after the first step."""

    def __init__(self, fmu, status):
        self.fmu, self.status, self.calls = fmu, status, None

    def __getattr__(self, name):
        if self.calls is not None:
            self.calls.append(name)
        return getattr(self.fmu, name)

    def doStep(self, **at):
        self.calls = []
        if self.status:
            raise fmpy.fmi1.FMICallException("fmi2DoStep", self.status)
        self.fmu.doStep(**at)


@needs_compiler
@pytest.mark.parametrize(
    ("status", "allowed"), [(0, ["getReal", "terminate", "freeInstance"]), (3, ["freeInstance"]), (4, [])]
)
def test_after_an_error_only_what_the_standard_allows_is_called(turbine, status, allowed):
    """FMI 2.0.4, 4.2.4: an FMU with an error is freed without its termination, and a fatal one is left alone."""
    made = environment(turbine)
    entries = made.reset()
    recorded = made._fmu = Recorded(made._fmu, status)
    entries.set("action", torch.zeros(2, dtype=torch.float64))
    if status:
        with pytest.raises(FMUError, match=r"the FMU turbine.fmu refuses a call at t = 0 s"):
            made.step(entries)
    else:
        made.step(entries)
    first = made._folder
    assert made.reset()["outputs"].isfinite().all() and recorded.calls == allowed
    assert (made._folder == first) == (status != 4) and Path(made._folder).exists()
    made.close()
    assert not Path(made._folder).exists()


@needs_compiler
def test_an_fmu_takes_the_inputs_that_act_and_what_does_not_fit_is_refused(turbine, tmp_path):
    seen = WindTurbine(horizon=20.0, observe=("preview",))
    entries = environment(turbine, seen).reset()
    assert entries["exogenous"].shape == (len(seen.inputs),) and len(seen.inputs) > 1
    (tmp_path / "no.fmu").write_text("nothing")
    for wrong, message in (
        (lambda: environment(tmp_path / "no.fmu"), "is no FMU that can be read"),
        (
            lambda: environment(turbine, outputs=["omega"]),
            r"outputs \['omega'\] are no variables of type Real in tur",
        ),
        (lambda: environment(turbine, exogenous=["a", "b"]), "must name 1 variables, or none"),
        (lambda: export_policy_fmu(torch.nn.Identity(), tmp_path / "policy.zip", PLANT), "must end in .fmu"),
    ):
        with pytest.raises(ValueError, match=message):
            wrong()
