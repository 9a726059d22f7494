"""A run folder read back: the plant, the trained policies and the closure, without training anything."""

import dataclasses
import json
import types
import typing
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.runs.command_line import load_recipe
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.runs.run_settings import RAN
from rt_torchrl.runs.tensor_file import load_tensors


@dataclass(frozen=True, kw_only=True)
class FinishedRun:
    """What a run left, on the CPU.

    Args:
        config: options of the run.
        plant: the real system in simulation, new.
        policies: as trained, by role: ``model_based`` and ``model_free``.
        closure: of the twin, as trained.
    """

    config: RunConfig
    plant: Plant
    policies: dict[str, nn.Module]
    closure: nn.Module

    @classmethod
    def load(cls, folder: Path, config_class: type[RunConfig]) -> "FinishedRun":
        """Read ``config.json`` and ``weights.pt`` of a run folder.

        Args:
            folder: the run folder.
            config_class: the ``Config`` of the recipe that made it, see :func:`config_class_of`.

        Raises:
            ValueError: if the folder holds no finished run, or one that the recipe of today cannot rebuild.
        """
        settings, weights = read_settings(folder), _read_weights(folder)
        name = settings.pop("plant")
        if not hasattr(config_class, "plant"):
            raise ValueError(
                f"{config_class.__qualname__} has no method plant() that makes the plant from its options."
            )
        try:
            config = rebuilt(config_class, settings)
            plant = config.plant()
        except (ValueError, TypeError, OSError) as error:
            raise ValueError(f"{folder / 'config.json'} cannot be carried out: {error}") from error
        if plant.name != name:
            raise ValueError(
                f"{folder} is a run of plant {name!r}, the recipe is of {plant.name!r}; use the run's own."
            )
        generator = torch.Generator().manual_seed(config.seed)
        parts = {role: config.make_policy(plant, generator) for role in weights if role != "closure"}
        parts["closure"] = plant.make_closure(generator)
        for role, part in parts.items():
            try:
                part.load_state_dict(weights[role])
            except (RuntimeError, KeyError) as error:
                raise ValueError(f"weights of {role!r} in {folder / 'weights.pt'} do not fit: {error}") from error
        return cls(config=config, plant=plant, closure=parts.pop("closure"), policies=parts)

    def policy(self, role: str) -> nn.Module:
        """The trained policy of a role.

        Raises:
            ValueError: if there is none.
        """
        if role not in self.policies:
            raise ValueError(f"role={role!r} does not exist in this run; choose {' or '.join(sorted(self.policies))}.")
        return self.policies[role]


def read_settings(folder: Path) -> dict[str, Any]:
    """The options a run was asked for, and the name of its ``plant``.

    Raises:
        ValueError: if the folder is not that of a run.
    """
    file = folder / "config.json"
    if not file.is_file():
        raise ValueError(
            f"{folder} is no run folder: it has no config.json. Give the folder that a recipe printed at its end, such "
            "as runs/wind_turbine/TIME-seed-0."
        )
    try:
        settings = json.loads(file.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{file} is damaged: {error}") from error
    if not isinstance(settings, dict) or "plant" not in settings:
        raise ValueError(f"{file} is not that of a run: it does not name a plant.")
    settings.pop(RAN, None)
    return settings


def _read_weights(folder: Path) -> dict[str, dict[str, torch.Tensor]]:
    file = folder / "weights.pt"
    if not file.is_file():
        raise ValueError(
            f"the run in {folder} has no weights.pt: it is not finished. Go on with it by --resume; Ctrl-C ends it "
            "and leaves the weights of the episodes done."
        )
    return load_tensors(file)


def config_class_of(recipe: Path) -> type[RunConfig]:
    """The class ``Config`` of a recipe, which is imported for it; see :func:`load_recipe` for errors."""
    return load_recipe(recipe).Config


def rebuilt(kind: Any, value: Any) -> Any:
    """A value of a type from what JSON holds of it: dataclasses from objects, tuples from lists, paths from
    strings.

    An option that is new since then has its default.

    Raises:
        ValueError: if a dataclass has no option of that name, or refuses its value.
    """
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        unknown = sorted(set(value) - {field.name for field in dataclasses.fields(kind)})
        if unknown:
            raise ValueError(f"{kind.__name__} has no option {', '.join(unknown)}; it is of another version or recipe.")
        return kind(**{name: rebuilt(hints[name], entry) for name, entry in value.items()})
    arguments = typing.get_args(kind)
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        (kind,) = (argument for argument in arguments if argument is not type(None))
        return None if value is None else rebuilt(kind, value)
    if typing.get_origin(kind) in (tuple, Sequence):
        alike = typing.get_origin(kind) is Sequence or arguments[-1] is Ellipsis
        kinds = arguments[:1] * len(value) if alike else arguments
        return tuple(rebuilt(each, entry) for each, entry in zip(kinds, value, strict=True))
    return Path(value) if kind is Path else value
