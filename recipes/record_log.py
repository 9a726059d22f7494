"""Write the log of a simulated real system for ``identify.py``, with jittered intervals, noisy sensors and a gap."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import torch
import tyro

from rt_torchrl import ClassicalController, Plant, check_options, main_of
from rt_torchrl.envs.cryogenic_tank.controllers import PIValve
from rt_torchrl.envs.flapping_wing.controllers import TrimmedPD
from rt_torchrl.envs.wind_turbine.jonkman import JonkmanController
from rt_torchrl.fit.sensor_log import SensorLog, logged_states
from rt_torchrl.fit.simulated_log import ClassicalLaw, Law, policy_law, recorded
from rt_torchrl.runs.shipped_plants import plant_class
from rt_torchrl.runs.tensor_file import load_tensors

CONTROLLERS: dict[str, type[ClassicalController]] = {
    "wind_turbine": JonkmanController,
    "flapping_wing": TrimmedPD,
    "cryogenic_tank": PIValve,
}


@dataclass(frozen=True, kw_only=True)
class Config:
    """Fly one episode of a plant and write the log that a data logger would write.

    Args:
        log: log file to write, CSV or Parquet.
        plant: name of a folder under envs, or FILE.py:NAME or package.module:NAME of your own plant.
        law: law of the actions: classical for the plant's classical controller, policy for a policy.
        weights: weights.pt of a training with the paper's policy; by default the policy has random first weights.
        role: role of the policy in the training.
        states: names of the states that are logged; by default all.
        seed: seed of the episode and of a policy's first weights.
        horizon: length of the episode [s]; by default the plant's.
        jitter: greatest difference of a control interval from dt, as a share of dt; by default 0.4, or 0 for a plant
            with a scheme of its own.
        noise: standard deviation of the states' sensors, as a share of what they read.
        gap: share of the log that is missing, from its middle on.
    """

    log: Annotated[Path, tyro.conf.Positional]
    plant: str
    law: Literal["classical", "policy"] = "classical"
    weights: Path | None = None
    role: Literal["model_based", "model_free"] = "model_based"
    states: tuple[str, ...] = ()
    seed: int = 0
    horizon: float | None = None
    jitter: float | None = None
    noise: float = 0.005
    gap: float = 0.02

    def __post_init__(self):
        check_options(self)
        known = [state.name for state in logged_states(plant_class(self.plant))]
        unknown = [name for name in self.states if name not in known]
        if unknown:
            raise ValueError(f"states={unknown} of {self.plant!r} do not exist; choose of {', '.join(known)}.")
        if self.seed < 0:
            raise ValueError(f"seed={self.seed} must not be negative.")
        if self.law == "classical" and self.plant not in CONTROLLERS:
            raise ValueError(f"law='classical': no classical controller of {self.plant!r} is known; use policy.")
        if not 0.0 <= self.gap < 0.5:
            raise ValueError(f"gap={self.gap} must lie in [0, 0.5), a share of the log.")
        known = [state.name for state in logged_states(make_plant(self))]
        unknown = [name for name in self.states if name not in known]
        if unknown:
            raise ValueError(f"states={self.states}: {self.plant!r} logs no {', '.join(unknown)}; choose of {known}.")


def main(config: Config) -> None:
    plant, generator = make_plant(config), torch.Generator().manual_seed(config.seed)
    law = law_of(config, plant, generator)
    default = 0.0 if plant.own_scheme else 0.4
    jitter = default if config.jitter is None else config.jitter
    log = with_gap(recorded(plant, law, generator, jitter=jitter, noise=config.noise), config.gap)
    log = log.without([s.name for s in logged_states(plant) if config.states and s.name not in config.states])
    log.write(config.log)
    print(f"{len(log.times)} rows of plant {plant.name!r} in {config.log}: {', '.join(log.columns)}")


def make_plant(config: Config) -> Plant:
    """The plant with the requested horizon."""
    kind = plant_class(config.plant)
    return kind() if config.horizon is None else kind(horizon=config.horizon)


def law_of(config: Config, plant: Plant, generator: torch.Generator) -> Law:
    """The law that acts on the real system."""
    if config.law == "classical":
        return ClassicalLaw(CONTROLLERS[config.plant](plant))
    policy = plant.make_policy(generator)
    if config.weights:
        try:
            policy.load_state_dict(load_tensors(config.weights)[config.role])
        except (KeyError, RuntimeError) as error:
            raise ValueError(f"weights of {config.role!r} in {config.weights} do not fit: {error}") from error
    return policy_law(plant, policy)


def with_gap(log: SensorLog, share: float) -> SensorLog:
    """The log without a share of its rows, from the middle on."""
    middle, end = 0.5 * log.times[-1], (0.5 + share) * log.times[-1]
    return log.chosen((log.times <= middle) | (log.times > end))


if __name__ == "__main__":
    main_of(Config, main)
