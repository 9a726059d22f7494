"""A whole training whose real system is an FMU, against one whose real system is the plant."""

import json

import pytest
import torch
from c_build import needs_compiler
from test_fmu import environment

from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.export.fmu import export_twin_fmu
from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.runs.run import Run
from rt_torchrl.systems.fmu_environment import FMUEnvironment
from rt_torchrl.systems.reading import Reading
from rt_torchrl.systems.real_system import RealSystem

pytest.importorskip("fmpy")
OPTIONS = (
    *("--horizon", "60", "--episodes", "3", "--unseen", "3", "--untrained", "0", "--no-figures", "--threads", "1"),
    *("--twinning.learner.critic-iterations", "30", "--twinning.learner.actor-iterations", "30"),
    # L-BFGS makes per cents of the last digit in some tens of steps; these two methods do not.
    *("--twinning.assimilation.method", "levenberg_marquardt", "--twinning.assimilation.iterations", "10"),
    *("--twinning.planner.descent.optimiser", "adam", "--twinning.planner.iterations", "5"),
    *("--start", "random", "--policy", "paper"),
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


class InPlace(FMUEnvironment):
    """The same environment, in which no machine code of the FMU runs."""

    def _instantiated(self):
        return PlantInPlace(self.plant)


def trained(folder, path, kind):
    """The results of a short training with all six steps."""
    from pathlib import Path

    recipe = load_recipe(Path(__file__).parent.parent / "recipes" / "wind_turbine.py")
    config = from_command_line(recipe.Config, [*OPTIONS, "--log-dir", str(folder)])
    plant = config.plant()
    names = [f"state.{s.name}" for s in plant.states]

    def start(generator):
        return dict(zip(names, plant.draw_initial_state(1, generator)[0].tolist(), strict=True))

    given = {"actions": [f"command.{s.name}" for s in plant.actions], "outputs": names}
    system = kind(path, plant, **given, exogenous=["exogenous.wind_speed"], start=start, seed=5)
    real = RealSystem(
        system, plant, state=Reading(keys=("outputs",)), exogenous=Reading(keys=("exogenous",)), closure=plant.closure
    )
    Run(config, plant, env=real, first=JonkmanController).train()
    real.close()
    return json.loads((folder / "metrics.json").read_text())


@needs_compiler
@pytest.mark.nightly
def test_a_training_on_an_fmu_is_one_on_the_plant(tmp_path):
    """Rounding of the C code is all that parts them; three episodes of learning let it grow."""
    plant = WindTurbine(horizon=60.0, observe=("measured+wind",))
    export_twin_fmu(plant.closure, tmp_path / "turbine.fmu", plant)
    assert environment(tmp_path / "turbine.fmu")
    found, expected = (
        trained(tmp_path / kind.__name__, tmp_path / "turbine.fmu", kind) for kind in (FMUEnvironment, InPlace)
    )
    pairs = zip(found["episodes"], expected["episodes"], strict=True)
    for one, other in pairs:
        assert one["real_cost"] == pytest.approx(other["real_cost"], rel=1e-6)
        assert (one["live"], one["event"]) == (other["live"], other["event"])
    for role in ("model_based", "model_free"):
        costs = [one["summary"]["unseen"][f"J_a_{role}"]["mean"] for one in (found, expected)]
        assert costs[0] == pytest.approx(costs[1], rel=1e-6)
    # Of combinations of weights that hardly change J_p, rounding decides more.
    assert found["summary"]["closure"]["found"] == pytest.approx(expected["summary"]["closure"]["found"], rel=1e-3)
