"""ROSCO's controller beside the learned one, in ROSCO's simulator: ``uv run --extra rosco tests/rosco_peer.py``.

Each row of the table is a set of options of ``recipes/wind_turbine.py --task engineering``, trained with several seeds,
or a tuning of ROSCO. All of them fly the same turbulent winds, which no training has drawn, and are measured at every
step of the simulator. What is in the folder is not done again.
"""

import argparse
import ast
import math
import shlex
import statistics
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import torch
from ruler import kept, span, train

from rt_torchrl import load_run
from rt_torchrl.envs.wind_turbine import rosco as simulator
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.evaluation.unseen import UNSEEN_SEED
from rt_torchrl.systems.real_system import episode_seed

MEASURES = {
    "mean power [MW]": 4,
    "speed deviation [rad/s]": 3,
    "speed excess [rad/s]": 3,
    "top speed [rad/s]": 4,
    "pitch travel [deg/s]": 3,
    "power deviation [MW]": 4,
    "power travel [kW/s]": 3,
}
"""The measures of an episode, see :func:`measured`, and how many digits of them are printed."""
TUNINGS = ("", "WE_Mode=2", "WE_Mode=2 PS_Mode=0")
"""Parameters of ROSCO: as this library flies it, with its estimator of the wind, and without a limit of the thrust."""


class Recorder:
    """Stands between the simulator and a controller's interface, and notes wind, rotor speed, torque and pitch."""

    def __init__(self, interface):
        self.interface, self.rows = interface, []

    def call_controller(self, report):
        torque, pitch, yaw = self.interface.call_controller(report)
        self.rows.append((float(report["ws"]), float(report["rot_speed"]), torque, math.degrees(pitch)))
        return torque, pitch, yaw

    def kill_discon(self):
        """Do nothing; the library is unloaded in :func:`rosco_flown`."""


def measured(rows):
    """Means over an episode of rows (wind [m/s], rotor speed [rad/s], torque [N m], pitch [deg]), ``STEP`` apart.

    The deviation of the generator speed is that while the wind is above rated; the excess is the root of the mean
    square of the speed above rated, as in ``WindTurbine.merit``. Travel is the mean of the rate's size.
    """
    wind, rotor_speed, torque, pitch = np.array(rows).T
    speed, seconds = WindTurbine.gear_ratio * rotor_speed, simulator.STEP * (len(rows) - 1)
    power = torque * speed
    values = (
        1e-6 * power.mean(),
        speed[wind > WindTurbine.rated_wind_speed].std(),
        np.sqrt(np.square(np.maximum(speed - WindTurbine.rated_generator_speed, 0.0)).mean()),
        speed.max(),
        np.abs(np.diff(pitch)).sum() / seconds,
        1e-6 * power.std(),
        1e-3 * np.abs(np.diff(power)).sum() / seconds,
    )
    return dict(zip(MEASURES, map(float, values), strict=True))


def mean_over(episodes):
    """The mean of each measure over episodes."""
    return {name: statistics.fmean(episode[name] for episode in episodes) for name in MEASURES}


@torch.no_grad()
def policy_flown(plant, policy, seed):
    """The rows of an episode under a policy, which decides once in a control interval."""
    recorders, t = [], torch.zeros(1, dtype=torch.float64)

    def decide(state, wind, report):
        observation = plant.observe(t, state[None], state.new_tensor([[wind]]))
        return plant.actuate(state, policy(observation)[0])

    def answer(start, wind):
        recorders.append(Recorder(simulator.Answer(plant, start, wind, decide, simulator.steps_of(plant))))
        return recorders[0]

    simulator.simulate(plant, seed, answer)
    return recorders[0].rows


def rosco_flown(plant, seed, **tuning):
    """The rows of an episode under ROSCO's controller, which decides at every step of the simulator."""
    recorders = []

    def answer(start, wind):
        recorders.append(Recorder(simulator.controller_interface(Path(folder), **tuning)))
        return recorders[0]

    with tempfile.TemporaryDirectory() as folder, simulator.silenced():
        simulator.simulate(plant, seed, answer)
        simulator.unload(recorders[0].interface)
    return recorders[0].rows


def learned(options, seed, folder, winds):
    """Means over winds, given by their seeds, of the live policy of a training."""
    words = ("--task", "engineering", *shlex.split(options))
    run = load_run(train("wind_turbine", words, seed, folder / "run"))
    policy = run.policy(run.live)
    return mean_over([measured(policy_flown(run.plant, policy, wind)) for wind in winds])


def tuned(options, winds):
    """Means over winds of ROSCO's controller with parameters such as ``PS_Mode=0 omega_pc=0.3``."""
    tuning = {name: ast.literal_eval(value) for name, value in (each.split("=") for each in shlex.split(options))}
    return mean_over([measured(rosco_flown(WindTurbine(), wind, **tuning)) for wind in winds])


def row(name, results):
    """A row of the table: each measure's least and greatest over seeds."""
    cells = [span([result[measure] for result in results], digits) for measure, digits in MEASURES.items()]
    return f"| {name} | {len(results)} | {' | '.join(cells)} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="seeds of the training with default options; 0 for none")
    parser.add_argument("--also", action="append", default=[], help="further options of a training, in one string")
    parser.add_argument("--also-seeds", type=int, default=1, help="seeds of each training with further options")
    parser.add_argument("--tuning", action="append", default=[], help="parameters of ROSCO: 'PS_Mode=0 omega_pc=0.3'")
    parser.add_argument("--winds", type=int, default=20)
    parser.add_argument("--first-wind", type=int, default=20, help="0 to 19 and 40 to 59 chose the weights of the page")
    parser.add_argument("--folder", type=Path, default=Path("runs/rosco_peer"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(f"| controller | seeds | {' | '.join(MEASURES)} |")
    print("|---" * (2 + len(MEASURES)) + "|")
    numbers = range(options.first_wind, options.first_wind + options.winds)
    winds, file = [episode_seed(UNSEEN_SEED, number) for number in numbers], f"winds-{numbers[0]}-{numbers[-1]}.json"
    for given in (*TUNINGS, *options.tuning):
        name = f"ROSCO {given}".strip()
        result = kept(options.folder / name / file, partial(tuned, given, winds))
        print(row(name, [result]), flush=True)
    for given, seeds in (("", options.seeds), *((each, options.also_seeds) for each in options.also)):
        folders = [options.folder / (given or "default") / str(seed) for seed in range(seeds)]
        results = [
            kept(folder / file, partial(learned, given, seed, folder, winds)) for seed, folder in enumerate(folders)
        ]
        if not results:
            continue
        print(row(f"learned {given}".strip(), results), flush=True)


if __name__ == "__main__":
    main()
