"""NREL's ROSCO simulator of the 5-MW turbine as a real system, and ROSCO's own controller for comparison.

The simulator owns its loop and calls a controller; here a policy answers the call. Source:
https://github.com/NREL/ROSCO, Apache License 2.0.
"""

import contextlib
import copy
import math
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.evaluation.unseen import RealController
from rt_torchrl.loading import of_extra
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.sampling import whole_multiple
from rt_torchrl.systems.adapters import CallingSimulator, Controller
from rt_torchrl.systems.real_system import Reading, RealSystem, episode_seed
from rt_torchrl.trajectories.trajectory import Trajectory

Report = Mapping[str, Any]
"""What ROSCO's simulator tells its controller at a step."""
Decide = Callable[[Tensor, float, Report], Tensor]
STEP = 0.1
"""Time step of ROSCO's simulator, which integrates the rotor by Euler's method [s]."""


@cache
def rosco() -> ModuleType:
    """ROSCO's toolbox with its modules, which the extra ``rosco`` installs."""
    for module in ("control_interface", "controller", "sim", "turbine", "utilities", "inputs.validation"):
        of_extra(f"rosco.toolbox.{module}", "rosco")
    return of_extra("rosco", "rosco")


def examples() -> Path:
    """The folder of the reference turbines in ROSCO's package."""
    return Path(str(rosco().__file__)).parent.parent / "Examples"


@cache
def parameters() -> dict[str, Any]:
    """ROSCO's own tuning input of the NREL 5-MW turbine."""
    return rosco().toolbox.inputs.validation.load_rosco_yaml(str(examples() / "Tune_Cases" / "NREL5MW.yaml"))


@cache
def nrel5mw() -> Any:
    """ROSCO's model of the turbine, read from its OpenFAST input."""
    case = examples() / "Test_Cases" / "NREL-5MW"
    with silenced():
        turbine = rosco().toolbox.turbine.Turbine(parameters()["turbine_params"])
        table = str(case / "Cp_Ct_Cq.NREL5MW.txt")
        turbine.load_from_fast("NREL-5MW.fst", str(case), rot_source="txt", txt_filename=table)
    turbine.table = table
    return turbine


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """A context in which neither Python nor the compiled controller, which bypasses Python, writes to the terminal."""
    sys.stdout.flush()
    stdout = os.dup(1)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        try:
            with contextlib.redirect_stdout(nowhere):
                yield
        finally:
            os.dup2(stdout, 1)
            os.close(stdout)


class Answer:
    """Takes the place of the compiled controller's interface in ROSCO's simulator.

    It holds the measured state of the plant: the reported rotor speed, the actuators, and filters that run along.

    Args:
        plant: the twin's physics, with signals, filters and actuators.
        start: state at the start of the episode, from which filters and actuators begin.
        wind: wind speeds of all control intervals [m/s].
        decide: function that returns the action (torque [N m], pitch [deg]) for a state, the wind of the interval to
            come, and the simulator's report. It is called every ``interval`` steps; in between the action is held.
        interval: number of steps of the simulator between two decisions.
    """

    def __init__(self, plant: Plant, start: Tensor, wind: np.ndarray, decide: Decide, interval: int):
        self.plant, self.turbine, self.state, self._wind = plant, turbine_of(plant), start.clone(), wind
        self._decide, self._interval, self._step = decide, interval, 0
        computed = ("generator_torque", "blade_pitch", "rotor_speed")
        self._filters = [k for k, signal in enumerate(plant.states) if signal.name not in computed]

    def call_controller(self, report: Report) -> tuple[float, float, float]:
        """Torque [N m], pitch [rad] and yaw rate [rad/s], as ROSCO's interface returns them."""
        speed = float(report["rot_speed"])
        if self._step == 0:
            self.state[0] = speed
        else:
            self._follow(speed, float(report["ws"]))
        if self._step % self._interval == 0:
            k = min(self._step // self._interval, len(self._wind) - 1)
            action = self._decide(self.state, float(self._wind[k]), report)
            t, exogenous = self.state.new_tensor(STEP * self._step), self.state.new_tensor([self._wind[k]])
            self.state = self.plant.latch(self.plant.memorise(t, self.state, exogenous), action)
        self._step += 1
        torque, pitch = self.state[4:6].tolist()
        share = self.turbine.cut_in(torch.tensor(self.turbine.gear_ratio * speed, dtype=torch.float64)).item()
        return torque * share, math.radians(pitch), 0.0

    def _follow(self, rotor_speed: float, wind: float) -> None:
        """Take the filters over one step of the simulator by Heun's method, under the wind that acted in it."""
        before, after = self.state, self.state.clone()
        after[0] = rotor_speed
        slope = self._slope(before, wind)
        after[self._filters] += STEP * slope
        after[self._filters] += 0.5 * STEP * (self._slope(after, wind) - slope)
        self.state = after

    def _slope(self, state: Tensor, wind: float) -> Tensor:
        t, exogenous = state.new_zeros(()), state.new_tensor([wind])
        return self.plant.vector_field(t, state, state[4:6], exogenous, self.plant.closure)[self._filters]

    def kill_discon(self) -> None:
        """Do nothing, because there is no library to unload."""


def turbine_of(plant: Plant) -> WindTurbine:
    """The turbine itself.

    Raises:
        ValueError: if the plant is no turbine, has states that no sensor reads, or observes a preview of the wind.
    """
    turbine = plant.innermost
    if not isinstance(turbine, WindTurbine) or plant.unread or plant.previews:
        raise ValueError(
            f"plant {plant.name!r} must be a WindTurbine without hidden states, which ROSCO simulates, and without "
            "previews of the wind, because its simulator has no lidar; observe measured+wind."
        )
    return turbine


def simulate(plant: Plant, seed: int, answer: Callable[[Tensor, np.ndarray], Any]) -> None:
    """Run one episode of ROSCO's simulator, with a start and a wind that the plant draws from the seed.

    Args:
        plant: the twin's physics.
        seed: seed of the episode.
        answer: function that makes the controller interface from start state and wind.
    """
    generator = torch.Generator().manual_seed(seed)
    start = plant.draw_initial_state(1, generator)[0]
    wind = plant.draw_exogenous(1, generator)[0, :, 0].numpy()
    # The simulator moves once before its first call, and it uses the wind at the end of a step.
    series = np.concatenate([wind[:1], wind[:1], wind.repeat(steps_of(plant))])
    interface = answer(start, wind)
    simulator = rosco().toolbox.sim.Sim(nrel5mw(), interface)
    with torch.no_grad():
        simulator.sim_ws_series(
            STEP * np.arange(len(series)), series, rotor_rpm_init=start[0].item() * 30.0 / math.pi, make_plots=False
        )


def steps_of(plant: Plant) -> int:
    """The number of the simulator's steps in a control interval, which must be a multiple of them."""
    return whole_multiple("dt", plant.dt, STEP)


def rosco_turbine(plant: Plant, *, seed: int = 0, device: torch.device | str = "cpu") -> RealSystem:
    """ROSCO's simulator as the real system, with the plant's ranges and rates of the actuators; it has none itself.

    Args:
        plant: the twin's physics, which also draws start and wind of every episode.
        seed: seed of the episodes.
        device: device of the reported tensors.

    Raises:
        ValueError: if ROSCO is not installed, the plant's control interval does not fit, or the plant is none that
            ROSCO simulates.
    """
    turbine_of(plant)
    interval = steps_of(plant)
    rosco()
    machine = copy.deepcopy(plant).cpu()  # the simulator's side, wherever the twin's is

    def run(seed: int, controller: Controller) -> None:
        def decide(state: Tensor, wind: float, report: Report) -> Tensor:
            command = controller({"state": state.numpy(), "wind": [wind]})
            return machine.actuate(state, torch.from_numpy(command))

        simulate(machine, seed, lambda start, wind: Answer(machine, start, wind, decide, interval))

    env = CallingSimulator(run, {"state": len(plant.states), "wind": 1}, plant.actions)
    wind = Reading(keys=("wind",))
    return RealSystem(env, plant, state=Reading(keys=("state",)), exogenous=wind, seed=seed, device=device)


class RoscoController(RealController):
    """ROSCO's compiled controller in ROSCO's simulator, with ROSCO's tuning for this turbine.

    The controller decides at every step of the simulator. The action at the start of a control interval counts as the
    applied action of that interval. :class:`RealController` describes the arguments.
    """

    plant: Plant

    def fly_real(self, count: int, *, seed: int) -> Trajectory:
        """The episodes that :func:`rosco_turbine` runs from the same seed."""
        episodes = [self._episode(episode_seed(seed, number)) for number in range(count)]
        device = turbine_of(self.plant).greatest_increment.device
        states, applied, wind = (torch.stack(values).to(device) for values in zip(*episodes, strict=True))
        return Trajectory(states, applied, wind.unsqueeze(-1))

    def _episode(self, seed: int) -> tuple[Tensor, Tensor, Tensor]:
        """States, applied actions and wind at every control interval."""
        plant = copy.deepcopy(self.plant).cpu()
        interval = steps_of(plant)
        states, applied, winds = [], [], []
        with tempfile.TemporaryDirectory() as folder:
            interface = controller_interface(Path(folder))

            def decide(state: Tensor, wind: float, report: Report) -> Tensor:
                torque, pitch, _ = interface.call_controller(report)
                states.append(state)
                applied.append(torch.tensor([torque, math.degrees(pitch)], dtype=torch.float64))
                winds.append(wind)
                return applied[-1]

            with silenced():
                simulate(plant, seed, lambda start, wind: Answer(plant, start, wind.repeat(interval), decide, 1))
                unload(interface)
        wind = torch.tensor(winds[::interval][:-1], dtype=torch.float64)
        return torch.stack(states[::interval]), torch.stack(applied[::interval])[:-1], wind


def controller_interface(folder: Path, **tuning: float) -> Any:
    """ROSCO's controller with ROSCO's tuning, and with its inputs and logs in a folder.

    The controller measures the wind and does not estimate it, because ROSCO's simulator is known to upset
    the estimators.

    Args:
        folder: folder of the inputs and logs.
        tuning: parameters of ROSCO's tuning that replace its own, such as ``PS_Mode=0`` for no limit of the thrust.
    """
    toolbox, path = rosco().toolbox, str(folder / "DISCON.IN")
    with silenced():
        controller = toolbox.controller.Controller(
            parameters()["controller_params"] | {"WE_Mode": 0, "LoggingLevel": 0} | tuning
        )
        controller.tune_controller(nrel5mw())
        toolbox.utilities.write_DISCON(nrel5mw(), controller, param_file=path, txt_filename=nrel5mw().table)
        return toolbox.control_interface.ControllerInterface(
            rosco().discon_lib_path, param_filename=path, sim_name=str(folder / "rosco"), DT=STEP
        )


def unload(interface: Any) -> None:
    """Unload ROSCO's controller, and have its Fortran runtime write its buffers now and not later."""
    if hasattr(interface.discon, "_gfortran_flush_i4"):
        interface.discon._gfortran_flush_i4(None)
    interface.kill_discon()
