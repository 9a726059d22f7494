"""The file ``config.json`` of a run folder: the options of a run, its plant, and the recipe that made it."""

import dataclasses
import functools
import importlib
import importlib.metadata
import importlib.util
import inspect
import json
import platform
import shlex
import sys
import time
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import nn

import rt_torchrl
from rt_torchrl.atomic_file import read_json, write_atomically
from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.runs.run_config import RunConfig

FILE = "config.json"
RAN = "ran"
"""Key of the list with an entry for every start of the run."""
CONTROLLERS = "controllers"
"""Key of the numbers of the classical controllers, by their names."""
BESIDE = ("plant", "recipe", CONTROLLERS, RAN)
"""Keys of ``config.json`` that are not options."""
OF_EVERY_RUN = frozenset(option.name for option in dataclasses.fields(RunConfig))
GIVE = "give the recipe: its file, or in code the class itself"


def settings_of(config: RunConfig, plant: str) -> dict[str, Any]:
    """Settings of a run for ``config.json``.

    Args:
        config: options as they were asked for.
        plant: name of the plant.

    Returns:
        Every option; ``plant``; and ``recipe``, the place where the class of the configuration is defined, with
        ``class`` and ``file`` (null for an interactive session).
    """
    return dataclasses.asdict(config) | {"plant": plant, "recipe": _origin(type(config))}


def task_of(settings: dict[str, Any]) -> dict[str, Any]:
    """The options that make plant, inputs and cost: those that only this recipe has, but what policies observe."""
    return {key: value for key, value in settings.items() if key not in {*OF_EVERY_RUN, *BESIDE, "observe"}}


def read_settings(folder: Path) -> dict[str, Any]:
    """The result of :func:`settings_of` when the run of a folder was made.

    Raises:
        ValueError: if the folder is not a run folder, or its settings are damaged.
    """
    file = folder / FILE
    if not file.is_file():
        raise ValueError(
            f"{folder} is no run folder: it has no {FILE}. Give the folder that a recipe printed at its end, such "
            "as runs/wind_turbine/TIME-seed-0."
        )
    settings = read_json(file)
    if not isinstance(settings.get("plant"), str):
        raise ValueError(f"{file} is not that of a run: it does not name a plant.")
    return settings


def class_of(folder: Path, settings: dict[str, Any]) -> type[RunConfig]:
    """The configuration class that the settings of a run name, from the file that defines it, which is run.

    A file in the run folder is not run, because the folder comes from somewhere else.

    Raises:
        ValueError: if the settings name no class, the class is not found any more or belongs to no configuration, or
            its file lies in the run folder.
    """
    origin: Any = settings.get("recipe")
    place = folder / FILE
    if origin == _origin(RunConfig):
        return RunConfig
    try:
        name, path = str(origin["class"]), Path(origin["file"])
    except (TypeError, KeyError) as error:
        raise ValueError(f"{place} does not say in which file the class is that made the run; {GIVE}.") from error
    if not path.is_absolute() or path.resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"recipe {path} in {place} is not run: it came with the folder. To trust it, {GIVE}.")
    try:
        return require_config(attribute(module_of(path), name), name)
    except (ValueError, ImportError) as error:
        raise ValueError(f"the recipe that {place} names is not found: {error} If it has moved, {GIVE}.") from error


def require_config(config_class: Any, name: str) -> type[RunConfig]:
    """The object, once it is certain that it is a class derived from ``RunConfig``.

    Args:
        config_class: object to check.
        name: name of the object in an error.

    Raises:
        ValueError: if it is not such a class.
    """
    if not (isinstance(config_class, type) and issubclass(config_class, RunConfig)):
        raise ValueError(f"{name} is no class derived from RunConfig.")
    return config_class


def _origin(config_class: type) -> dict[str, str | None]:
    """Name and file of a recipe's class; no file for the class of this library, and in an interactive session."""
    file = getattr(sys.modules.get(config_class.__module__), "__file__", None)
    known = None if config_class is RunConfig or file is None else str(Path(file).resolve())
    return {"class": config_class.__qualname__, "file": known}


OF_THE_CALL = ("config", "log_dir", "resume")
"""Options that a file of options never gives."""
BESIDE_TRAINING = {"figures", "reference", "threads", *OF_THE_CALL}
"""Options of the place, the reports and the speed of a run, under which it trains and costs the same."""
HARMLESS = {*BESIDE_TRAINING, "episodes", "unseen_every", "real_unseen"}
"""Options that may differ when a run is resumed: these and those of its length."""


def numbers_of(law: nn.Module) -> dict[str, Any]:
    """Class, gains, tensors and other numbers of a classical controller, to six digits: machines round differently."""
    gains = dict(zip(law.gain_units, law.gains, strict=True)) if isinstance(law, ClassicalController) else {}
    own, tensors = {"log_gains", "low_action", "high_action"}, [*law.named_parameters(), *law.named_buffers()]
    kept = {name: x for name, x in tensors if name not in own and not name.startswith("plant.")}
    values = {name: inspect.getattr_static(law, name, None) for name in dir(law) if not name.startswith("_")}
    scalars = {name: torch.tensor(x) for name, x in values.items() if type(x) in (int, float)}
    entries = (scalars | kept | gains).items()
    numbers = {name: [float(f"{number:.6g}") for number in x.flatten().tolist()] for name, x in entries}
    return {"class": type(law).__name__} | numbers


def write_settings(
    folder: Path, config: RunConfig, effective: RunConfig, plant: str, controllers: Mapping[str, Any]
) -> None:
    """Write ``config.json``: the settings of the run, and ``ran`` with an entry for every start of the run.

    Args:
        folder: run folder.
        config: options as they were asked for.
        effective: options that the run carries out.
        plant: name of the plant.
        controllers: :func:`numbers_of` each classical controller, by its name.

    Raises:
        OSError: if the file cannot be written.
    """
    before = read_settings(folder).get(RAN, []) if config.resume else []
    versions = {name: importlib.metadata.version(name) for name in ("torch", "torchrl", "tensordict")}
    ran = {
        "effective": as_written(effective),
        "versions": {"python": platform.python_version(), "rt_torchrl": rt_torchrl.__version__} | versions,
        "command": shlex.join(sys.argv),
        "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }
    settings = settings_of(config, plant) | {CONTROLLERS: controllers, RAN: [*before, ran]}
    # Options may be infinite; JSON as Python writes it keeps them as they are.
    write_atomically(folder / FILE, (json.dumps(settings, indent=2, default=str) + "\n").encode())


def as_written(config: RunConfig) -> dict[str, Any]:
    """The options as JSON gives them back."""
    return json.loads(json.dumps(dataclasses.asdict(config), default=str))


def require_same(folder: Path, config: RunConfig, controllers: Mapping[str, Any]) -> None:
    """Refuse to go on with a run under options that differ from its own, except for harmless ones.

    Nor may a classical controller have other numbers than in the run: its flights tell nothing of another one.

    ``unseen`` is harmless too if the run has not judged any training episode on the unseen episodes.

    Raises:
        ValueError: if an option or a controller differs; it names what does, with both values.
    """
    settings = read_settings(folder)
    earlier: dict[str, Any] = settings.get(CONTROLLERS, {})
    changed = changes(earlier, controllers, earlier.keys() ^ controllers.keys())
    changed += differences(folder, config, HARMLESS if settings.get("unseen_every") else HARMLESS | {"unseen"})
    if changed:
        raise ValueError(
            f"log_dir={folder} is to be resumed with other options or another classical controller than its own: "
            f"{'; '.join(changed)}. Give the run's own, or another folder for a new run, which takes policies and twin "
            f"of this one by --start {folder}."
        )


def differences(folder: Path, config: RunConfig, harmless: AbstractSet[str]) -> list[str]:
    """What differs between the options of a run and those that are asked for, in words.

    Args:
        folder: run folder.
        config: options as they are asked for.
        harmless: options that may differ.

    Raises:
        ValueError: if the folder is not a run folder, or its settings are damaged.
    """
    return changes(read_settings(folder), as_written(config), {*harmless, *BESIDE})


def changes(earlier: Mapping[str, Any], present: Mapping[str, Any], but: AbstractSet[str] = frozenset()) -> list[str]:
    """What differs between the settings of a run and the present ones, in words, except for some names."""
    was, now = (flat({k: v for k, v in settings.items() if k not in but}) for settings in (earlier, present))
    pairs = [(name, now.get(name, "nothing"), was.get(name, "nothing")) for name in sorted(was.keys() | now.keys())]
    return [f"{name} is {new} here and was {old} in the run" for name, new, old in pairs if new != old]


def flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested options by their dotted names, as the command line has them."""
    options: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, dict) and value:
            options |= flat(value, f"{prefix}{name}.")
        else:
            options[prefix + name] = value
    return options


def module_of(file: Path) -> ModuleType:
    """The module in a file, imported only once; as a script does, it can import modules that lie beside the file.

    A script that is running is not run again.

    Raises:
        ValueError: if there is no such file, or it does not end in ``.py``.
    """
    if not file.is_file():
        raise ValueError(f"{file} does not exist; give a file with Python code.")
    file = file.resolve()
    for loaded in list(sys.modules.values()):
        place = getattr(loaded, "__file__", None)
        if place and Path(place).name == file.name and Path(place).resolve() == file:
            return loaded
    if str(file.parent) not in sys.path:
        sys.path.insert(0, str(file.parent))
    name = f"rt_torchrl_recipe_{file.stem}"
    while name in sys.modules:  # a file of the same name in another folder
        name += "_"
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ValueError(f"{file} is no Python code, by its name; give a file that ends in .py.")
    # Known by its name, because the command line looks up the source of its options for their help.
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def attribute(module: ModuleType, name: str) -> Any:
    """The object that a module defines under a name, which may have dots.

    Raises:
        ValueError: if the module does not define the name.
    """
    try:
        return functools.reduce(getattr, name.split("."), module)
    except AttributeError as error:
        raise ValueError(f"{module.__file__ or module.__name__} defines no {name}.") from error
