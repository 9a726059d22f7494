"""Any FMU for co-simulation as an environment, such as the real system of a training (FMI 2, by FMPy)."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds

Start = Callable[[torch.Generator], Mapping[str, float]]
"""Draws the values that variables of the FMU are set to before an episode, by name."""


class FMUError(RuntimeError):
    """The FMU has refused a call; the message names the FMU, the call and the time."""


class FMUEnvironment(EnvBase):
    """One FMU that is stepped once in a control interval; it reports ``outputs`` and ``exogenous``.

    :class:`RealSystem` makes it the real system of a plant, with ``state=Reading(keys=("outputs",))`` and
    ``exogenous=Reading(keys=("exogenous",))``.

    Args:
        path: the FMU.
        plant: plant that gives the control interval, the ranges of the actions, and draws the exogenous inputs.
        actions: variables of the FMU that take the actions, in the plant's order.
        outputs: variables that are reported.
        exogenous: variables that take the plant's exogenous inputs, in its order; empty for an FMU that has its own.
        start: function that draws what variables are set to before an episode; None leaves the FMU's own values.
        seed: seed of the first episode, until ``set_seed`` gives another; each later episode adds 1.

    Raises:
        ValueError: if FMPy is not installed, the file is no FMU for co-simulation, or a variable does not exist or the
            number of variables does not fit the plant.
        FMUError: in a reset or step that the FMU refuses.
    """

    observation_spec: Composite

    def __init__(
        self,
        path: Path | str,
        plant: Plant,
        *,
        actions: Sequence[str],
        outputs: Sequence[str],
        exogenous: Sequence[str] = (),
        start: Start | None = None,
        seed: int = 0,
    ):
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([]))
        self._fmpy, self.path, self.plant = _fmpy(), Path(path), plant
        self._description, self._places = self._read()
        for what, names, count in (("actions", actions, len(plant.actions)), ("exogenous", exogenous, None)):
            if count is not None and len(names) != count:
                raise ValueError(f"{what}={tuple(names)} must name {count} variables, one for each of the plant's.")
        if exogenous and len(exogenous) != len(plant.inputs):
            raise ValueError(f"exogenous={tuple(exogenous)} must name {len(plant.inputs)} variables, or none.")
        self._require({"actions": actions, "outputs": outputs, "exogenous": exogenous})
        self._actions, self._outputs, self._exogenous = tuple(actions), tuple(outputs), tuple(exogenous)
        self._start, self._seed, self._steps = start, seed, 0
        self._fmu: Any = None  # FMPy says no types
        self._folder = self._fmpy.extract(str(self.path))
        double = {"dtype": torch.float64}
        reported = {"outputs": Unbounded((len(outputs),), **double)}
        reported["exogenous"] = Unbounded((len(plant.inputs),), **double)
        self.observation_spec = Composite(reported)
        low, high = bounds(plant.actions)
        self.action_spec = Bounded(low, high, (len(actions),), **double)
        self.reward_spec = Unbounded((1,), **double)

    def _read(self) -> tuple[Any, dict[str, int]]:
        try:
            description = self._fmpy.read_model_description(str(self.path))
        except Exception as error:  # FMPy raises whatever its parser meets
            raise ValueError(f"path={self.path} is no FMU that can be read: {error}") from error
        if description.coSimulation is None or not description.fmiVersion.startswith("2."):
            raise ValueError(
                f"path={self.path} is an FMU of FMI {description.fmiVersion}; it must be one of FMI 2 for "
                "co-simulation."
            )
        # Of other types the same references are other variables.
        real = [variable for variable in description.modelVariables if variable.type == "Real"]
        return description, {variable.name: variable.valueReference for variable in real}

    def _require(self, names: Mapping[str, Sequence[str]]) -> None:
        for what, wanted in names.items():
            unknown = [name for name in wanted if name not in self._places]
            if unknown:
                raise ValueError(
                    f"{what} {unknown} are no variables of type Real in {self.path.name}; it has "
                    f"{', '.join(self._places)}."
                )

    def _set_seed(self, seed: int | None) -> None:
        self._seed = self._seed if seed is None else seed

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        generator = torch.Generator().manual_seed(self._seed)
        self._seed, self._steps = self._seed + 1, 0
        start = {} if self._start is None else dict(self._start(generator))
        self._require({"start": list(start)})
        self._inputs = self.plant.draw_exogenous(1, generator)[0]
        self._free()
        self._fmu = self._call("instantiate", self._instantiated)
        self._initialise(start)
        return self._report()

    def _instantiated(self) -> Any:
        return self._fmpy.instantiate_fmu(self._folder, self._description, "CoSimulation")

    def _initialise(self, start: Mapping[str, float]) -> None:
        fmu, stop = self._fmu, self.plant.horizon
        self._call("setupExperiment", lambda: fmu.setupExperiment(startTime=0.0, stopTime=stop))
        self._set(start)
        self._call("enterInitializationMode", fmu.enterInitializationMode)
        self._set(dict(zip(self._exogenous, self._now().tolist(), strict=False)))
        self._call("exitInitializationMode", fmu.exitInitializationMode)

    def _now(self) -> Float[Tensor, " n_z"]:
        return self._inputs[min(self._steps, len(self._inputs) - 1)]

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._fmu is None:
            raise RuntimeError("no episode is running; reset the environment before it is stepped.")
        values = dict(zip(self._actions, tensordict["action"].tolist(), strict=True))
        values |= dict(zip(self._exogenous, self._now().tolist(), strict=False))
        self._set(values)
        t, dt, fmu = self._steps * self.plant.dt, self.plant.dt, self._fmu
        self._call("doStep", lambda: fmu.doStep(currentCommunicationPoint=t, communicationStepSize=dt))
        self._steps += 1
        ends = {"done": torch.zeros(1, dtype=torch.bool), "terminated": torch.zeros(1, dtype=torch.bool)}
        return self._report().update(ends | {"reward": torch.zeros(1, dtype=torch.float64)})

    def _set(self, values: Mapping[str, float]) -> None:
        if values:
            places, fmu = [self._places[name] for name in values], self._fmu
            self._call(f"set {', '.join(values)}", lambda: fmu.setReal(places, list(values.values())))

    def _report(self) -> TensorDict:
        places, fmu = [self._places[name] for name in self._outputs], self._fmu
        found = self._call(f"get {', '.join(self._outputs)}", lambda: fmu.getReal(places))
        outputs = torch.tensor(list(found), dtype=torch.float64)
        return TensorDict({"outputs": outputs, "exogenous": self._now().clone()}, batch_size=self.batch_size)

    def _call(self, what: str, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except Exception as error:  # FMPy raises plain exceptions
            raise FMUError(
                f"the FMU {self.path.name} refuses to {what} at t = {self._steps * self.plant.dt:g} s: {error}"
            ) from error

    def _free(self) -> None:
        if self._fmu is not None:
            fmu, self._fmu = self._fmu, None
            fmu.terminate()
            fmu.freeInstance()

    def close(self, **kwargs: Any) -> None:
        """Free the FMU and what was unpacked of it."""
        self._free()
        shutil.rmtree(self._folder, ignore_errors=True)
        super().close(**kwargs)


def _fmpy() -> Any:
    try:
        import fmpy
        from fmpy.simulation import instantiate_fmu
    except ImportError as error:
        raise ValueError("FMUs need FMPy: install the extra, pip install 'rt_torchrl[fmu]'.") from error
    fmpy.instantiate_fmu = instantiate_fmu
    return fmpy
