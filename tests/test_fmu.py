"""FMUs: their content, what a simulator gets of them, and trainings on one."""

import ctypes
import json
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from c_build import needs_compiler

from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.export import c_file
from rt_torchrl.export.fmu import export_policy_fmu, export_twin_fmu
from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.runs.run import Run
from rt_torchrl.systems.adapters import FMUEnvironment, FMUError
from rt_torchrl.systems.real_system import Reading, RealSystem
from rt_torchrl.trajectories.rollout import Rollout

fmpy = pytest.importorskip("fmpy")
PLANT = WindTurbine(horizon=20.0)


@pytest.fixture(scope="module")
def turbine(tmp_path_factory):
    """The true turbine as an FMU."""
    path = tmp_path_factory.mktemp("fmu") / "turbine.fmu"
    export_twin_fmu(PLANT.closure, path, PLANT)
    return path


def environment(path, **options):
    given = {
        "actions": [f"command.{s.name}" for s in PLANT.actions],
        "outputs": [f"state.{s.name}" for s in PLANT.states],
        "exogenous": ["exogenous.wind_speed"],
    }
    return FMUEnvironment(path, PLANT, **given | options)


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
def test_an_fmu_has_every_function_of_the_standard(tmp_path):
    """By the header of the standard, which FMPy brings; a master may ask for all."""
    path = tmp_path / "turbine.fmu"
    export_twin_fmu(PLANT.closure, path, PLANT)
    folder = Path(fmpy.extract(str(path), unzipdir=str(tmp_path / "unpacked")))
    (library,) = (folder / "binaries").glob("*/*")
    header = Path(fmpy.__file__).parent / "c-code" / "fmi2FunctionTypes.h"
    common, exchange = header.read_text(encoding="utf-8").split("Functions for FMI2 for Model Exchange")
    names = set(FUNCTIONS.findall(common + exchange.split("Functions for FMI2 for Co-Simulation")[1]))
    assert len(names) > 30 and all(hasattr(ctypes.CDLL(str(library)), name) for name in names)
    assert fmpy.validation.validate_fmu(str(path)) == []
    units = {variable.name: variable.unit for variable in fmpy.read_model_description(str(path)).modelVariables}
    assert units["command.generator_torque"] == "N m" and units["state.rotor_speed"] == "rad/s"


SLAVE = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real

class Barrel(Fmi2Slave):
    def __init__(self, **options):
        super().__init__(**options)
        self.u, self.v, self.h = 0.0, 0.0, 1.0
        for name in "uv":
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        self.register_variable(Real("h", causality=Fmi2Causality.output))
        self.taps = 3
        kind = {"causality": Fmi2Causality.input, "variability": Fmi2Variability.discrete}
        self.register_variable(Integer("taps", **kind))

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
    with pytest.raises(ValueError, match=r"actions \['taps'\] are no variables of type Real in Barrel.fmu"):
        environment(path, actions=["u", "taps"], outputs=["h"], exogenous=[])
    made = environment(path, actions=["u", "v"], outputs=["h"], exogenous=[])
    entries, level = made.reset(), 1.0
    assert entries["outputs"].tolist() == [1.0]
    for _ in range(5):
        entries = made.step(entries.set("action", torch.tensor([1000.0, 0.0]).double()))["next"]
        level += 0.5 * (0.1 - 0.1 * level)
        assert entries["outputs"].item() == pytest.approx(level, abs=1e-12)
        entries = entries.exclude("reward")
    with pytest.raises(FMUError, match=r"the FMU Barrel.fmu refuses to doStep at t = 2.5 s"):
        made.step(entries.set("action", torch.tensor([41000.0, 0.0]).double()))
    assert made.reset()["outputs"].tolist() == [1.0]
    made.close()


class Stubborn:
    """An FMU that refuses every step, and to terminate after that."""

    def __init__(self):
        self.freed = False

    def refuse(self, **given):
        raise RuntimeError("fmi2Error")

    doStep = terminate = refuse
    setupExperiment = enterInitializationMode = exitInitializationMode = setReal = lambda self, *given, **times: None

    def getReal(self, places):
        return [0.0] * len(places)

    def freeInstance(self):
        self.freed = True


@needs_compiler
def test_an_fmu_that_refuses_to_terminate_is_freed_and_its_folder_removed(turbine, monkeypatch):
    instances = []
    monkeypatch.setattr(
        fmpy.simulation, "instantiate_fmu", lambda *given: instances.append(Stubborn()) or instances[-1]
    )
    made = environment(turbine)
    for _ in range(2):
        entries = made.reset()
        with pytest.raises(FMUError, match="refuses to doStep at t = 0 s: fmi2Error"):
            made.step(entries.set("action", torch.tensor([1e4, 0.0]).double()))
    folder = Path(made._folder)
    assert instances[0].freed and folder.is_dir()
    made.close()
    assert instances[1].freed and not folder.exists()


@needs_compiler
def test_what_does_not_fit_an_fmu_is_refused(turbine, tmp_path):
    (tmp_path / "no.fmu").write_text("nothing")
    for wrong, message in (
        (lambda: environment(tmp_path / "no.fmu"), "is no FMU that can be read"),
        (
            lambda: environment(turbine, outputs=["omega"]),
            r"outputs \['omega'\] are no variables of type Real in turbine.fmu",
        ),
        (lambda: environment(turbine, actions=["command.blade_pitch"]), "must name 2 variables"),
        (lambda: environment(turbine, exogenous=["a", "b"]), "must name 1 variables, or none"),
        (lambda: export_twin_fmu(PLANT.closure, tmp_path / "twin.zip", PLANT), "must end in .fmu"),
    ):
        with pytest.raises(ValueError, match=message):
            wrong()


def test_an_fmu_that_cannot_be_written_is_refused_before_the_work(tmp_path, monkeypatch):
    """The work would say more: that the policy does not fit the plant, and that nothing was checked."""
    with pytest.raises(ValueError, match="must end in .fmu"):
        export_policy_fmu(torch.nn.Identity(), tmp_path / "policy.zip", PLANT)
    monkeypatch.setattr(c_file, "COMPILERS", ("no_such_compiler",))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match="there is no C compiler here; install one"):
            export_twin_fmu(PLANT.closure, tmp_path / "twin.fmu", PLANT)


# A whole training whose real system is an FMU, against one whose real system is the plant.


OPTIONS = (
    *("--horizon", "60", "--episodes", "2", "--unseen", "3", "--no-figures", "--threads", "1"),
    *("--twinning.learner.critic-iterations", "30", "--twinning.learner.actor-iterations", "30"),
    # L-BFGS makes per cents of the last digit in some tens of steps; these two methods do not.
    *("--twinning.assimilation.method", "levenberg_marquardt", "--twinning.assimilation.iterations", "10"),
    *("--twinning.planner.descent.optimiser", "adam", "--twinning.planner.iterations", "5"),
    *("--start", "random", "--policy", "paper"),
    # Nor does the choice among several twins, which are fitted by L-BFGS.
    *("--twinning.hypotheses.which", "none"),
)


class PlantInPlace:
    """The calls of an FMU, answered by the plant in torch; the references are those of the FMU."""

    def __init__(self, plant):
        self.plant, self.values = plant, [0.0] * (3 + len(plant.states))

    def setReal(self, places, values):
        for place, value in zip(places, values, strict=True):
            self.values[place] = value

    def getReal(self, places):
        return [self.values[place] for place in places]

    @torch.no_grad()
    def doStep(self, currentCommunicationPoint, communicationStepSize):
        tensors = [torch.tensor(part).double() for part in (self.values[3:], self.values[:2], self.values[2:3])]
        t = torch.tensor(currentCommunicationPoint).double()
        self.values[3:] = self.plant.step(t, *tensors, self.plant.closure).state.tolist()

    def setupExperiment(self, **options):
        pass

    enterInitializationMode = exitInitializationMode = terminate = freeInstance = lambda self: None


def trained(folder, path):
    """The results of a short training with all six steps."""
    from pathlib import Path

    recipe = load_recipe(Path(__file__).parent.parent / "recipes" / "wind_turbine.py")
    config = from_command_line(recipe.Config, [*OPTIONS, "--log-dir", str(folder)])
    plant = config.plant()
    names = [f"state.{s.name}" for s in plant.states]

    def start(generator):
        return dict(zip(names, plant.draw_initial_state(1, generator)[0].tolist(), strict=True))

    given = {"actions": [f"command.{s.name}" for s in plant.actions], "outputs": names}
    system = FMUEnvironment(path, plant, **given, exogenous=["exogenous.wind_speed"], start=start, seed=5)
    real = RealSystem(
        system, plant, state=Reading(keys=("outputs",)), exogenous=Reading(keys=("exogenous",)), closure=plant.closure
    )
    Run(config, plant, env=real, first=JonkmanController).train()
    real.close()
    return json.loads((folder / "metrics.json").read_text())


@needs_compiler
@pytest.mark.nightly
def test_a_training_on_an_fmu_is_one_on_the_plant(tmp_path, monkeypatch):
    """Rounding of the C code is all that parts them; every episode of learning lets it grow."""
    plant = WindTurbine(horizon=60.0, observe=("measured+wind",))
    export_twin_fmu(plant.closure, tmp_path / "turbine.fmu", plant)
    assert environment(tmp_path / "turbine.fmu")
    found = trained(tmp_path / "fmu", tmp_path / "turbine.fmu")
    # The same, in which no machine code of the FMU runs.
    monkeypatch.setattr(fmpy.simulation, "instantiate_fmu", lambda *given: PlantInPlace(plant))
    expected = trained(tmp_path / "in place", tmp_path / "turbine.fmu")
    pairs = zip(found["episodes"], expected["episodes"], strict=True)
    for one, other in pairs:
        assert one["real_cost"] == pytest.approx(other["real_cost"], rel=1e-6)
        assert (one["live"], one["event"]) == (other["live"], other["event"])
    for role in ("model_based", "model_free"):
        costs = [one["summary"]["unseen"][f"J_a_{role}"]["mean"] for one in (found, expected)]
        assert costs[0] == pytest.approx(costs[1], rel=1e-6)
    # Of combinations of weights that hardly change J_p, rounding decides more.
    assert found["summary"]["closure"]["found"] == pytest.approx(expected["summary"]["closure"]["found"], rel=1e-3)
