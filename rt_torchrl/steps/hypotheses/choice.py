"""The twin and its step 4 as a configuration asks for them."""

import copy

import torch
from torch import nn

from rt_torchrl.options import quoted
from rt_torchrl.plants.extension import Extension
from rt_torchrl.plants.plant import Plant
from rt_torchrl.steps.assimilate import Assimilation, SensorAssimilation
from rt_torchrl.steps.config import AssimilationConfig, HypothesesConfig
from rt_torchrl.steps.hypotheses.assimilation import EnsembleAssimilation
from rt_torchrl.steps.hypotheses.ensemble import TwinEnsemble
from rt_torchrl.trajectories.rollout import Engine
from rt_torchrl.trajectories.twin import DigitalTwin


def make_twin(
    plant: Plant,
    closure: nn.Module,
    config: HypothesesConfig,
    *,
    engine: Engine = "native",
    compiled: bool = False,
) -> DigitalTwin:
    """The twin of a plant, with the hypotheses and the risk that a configuration asks for.

    Each hypothesis begins with a copy of the closure.

    A configuration that names none takes all suspects of the plant; one that names some may name further ones, too.

    Raises:
        ValueError: if the plant suspects nothing of a name that the configuration lists.
    """
    suspects = plant.suspects() if config.which == "automatic" else {}
    if config.names:
        suspects = {**suspects, **plant.further_suspects()}
    unknown = [name for name in config.names if name not in suspects]
    if unknown:
        raise ValueError(
            f"hypotheses.names: plant {plant.name!r} does not suspect {quoted(unknown)}; choose among "
            f"{quoted(suspects) or '(nothing)'}, or give a TwinEnsemble of your own."
        )
    taken = {name: suspect for name, suspect in suspects.items() if not config.names or name in config.names}
    if not taken:
        return DigitalTwin(plant, closure, engine=engine, compiled=compiled)
    device = next((w.device for w in closure.parameters()), torch.device("cpu"))
    closures = {name: extended(suspect, copy.deepcopy(closure)).to(device) for name, suspect in taken.items()}
    twin = TwinEnsemble(plant, closure, taken, closures, engine=engine, compiled=compiled)
    twin.risk = config.risk
    return twin


def extended(suspect: Plant, closure: nn.Module) -> nn.Module:
    """A closure of the twin with the parameters of a suspect beside it.

    Raises:
        ValueError: if the suspect is no :class:`Extension`, so that nobody knows what its closure is.
    """
    if not isinstance(suspect, Extension):
        raise ValueError(
            f"suspect {type(suspect).__name__} of plant {suspect.name!r} is no Extension; give a TwinEnsemble with its "
            "closure instead."
        )
    return suspect.extended(closure)


def make_assimilation(
    twin: DigitalTwin, config: AssimilationConfig, hypotheses: HypothesesConfig, *, always: bool = False
) -> Assimilation:
    """Step 4 for a twin, or for an ensemble of them.

    Args:
        twin: the twin.
        config: parameters of step 4.
        hypotheses: parameters of the hypotheses.
        always: whether the twin alone is fitted in every episode; see :class:`EnsembleAssimilation`.

    Raises:
        ValueError: if hypotheses are to be fitted to some sensors alone, or the plant has no such sensor.
    """
    if config.sensors and isinstance(twin, TwinEnsemble):
        raise ValueError(
            f"sensors={config.sensors} of the assimilation do not go with hypotheses, which replay "
            "the whole state; leave the sensors out, or the hypotheses by hypotheses.which='none'."
        )
    if config.sensors:
        return SensorAssimilation(twin, config)
    if isinstance(twin, TwinEnsemble):
        return EnsembleAssimilation(twin, config, hypotheses, always=always)
    return Assimilation(twin, config)
