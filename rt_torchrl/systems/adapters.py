"""Simulators of others as environments: those that call their controller, and FMUs for co-simulation (FMI 2)."""

import contextlib
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from rt_torchrl.loading import of_extra
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal
from rt_torchrl.systems.environment import ForeignSystem

Report = Mapping[str, np.ndarray | Sequence[float]]
Controller = Callable[[Report], np.ndarray]
Simulation = Callable[[int, Controller], None]
Reports = SimpleQueue[Report | BaseException | None]
Actions = SimpleQueue[np.ndarray | None]
Start = Callable[[torch.Generator], Mapping[str, float]]
"""Draws the values that variables of the FMU are set to before an episode, by name."""


class EpisodeAbandoned(BaseException):
    """Ends an episode that nobody goes on with; it is raised where the simulator calls its controller."""


class CallingSimulator(ForeignSystem):
    """An environment around a simulator that runs whole episodes itself and calls a controller in them.

    Co-simulation, Bladed-style controller libraries and many course codes work like this: ``simulate(seed,
    controller)`` runs an episode and calls ``action = controller(reported)`` once for every control interval, and a
    last time at the end of the episode, where the action has no effect any more. Here the simulator runs in a thread
    that waits until the environment is stepped. :meth:`end_episode` answers a call that waits once more, with the last
    action, so that a simulator at the end of its episode finishes its work, such as writing results.
    :class:`RealSystem` calls it at the end of an episode, and so do a reset and :meth:`close`. A simulator that calls
    again meets :class:`EpisodeAbandoned` in this call and in every further one.

    Args:
        simulate: the simulator. ``reported`` maps names to the numbers behind them; the action is a vector in double
            precision.
        reports: number of values behind each reported name.
        actions: signals that the controller returns; their ranges become those of the environment's action.
        seed: seed of the first episode, until ``set_seed`` gives another; each later episode adds 1.

    Raises:
        ValueError: if ``reports`` or ``actions`` is empty, or a report lacks a name or has another size.
        RuntimeError: if the simulator fails, an episode never calls the controller, the simulator does not return from
            an episode that is abandoned, or the environment is stepped while no episode runs: before the first reset,
            or after an episode has ended or failed.
    """

    patience = 30.0
    """Longest time in which a simulator returns from an episode that is abandoned [s]."""

    def __init__(self, simulate: Simulation, reports: Mapping[str, int], actions: Sequence[Signal], *, seed: int = 0):
        if not reports or not actions:
            raise ValueError(f"reports={dict(reports)} and actions={list(actions)} must not be empty.")
        super().__init__(reports, actions, seed=seed)
        self._simulate, self._sizes = simulate, dict(reports)
        self._thread: Thread | None = None
        """The thread of the episode that is running."""

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        self.end_episode()
        self._reports, self._actions = Reports(), Actions()
        self._thread = Thread(target=self._run, args=(self._seed, self._reports, self._actions), daemon=True)
        self._thread.start()
        self._action = self.action_spec.zero().numpy()
        self._seed += 1
        first = self._listen()
        if first is None:
            raise RuntimeError("the simulator has ended its episode without calling its controller once.")
        self._last = self._entries(first)
        return self._last.clone()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Step to the next call of the controller; once the simulator has ended, repeat its last report and be done."""
        if self._thread is None:
            raise RuntimeError("no episode is running; reset the environment before it is stepped.")
        self._action = tensordict["action"].numpy().copy()
        self._actions.put(self._action)
        reported = self._listen()
        if reported is not None:
            self._last = self._entries(reported)
        return self._stepped(self._last.clone(), ended=reported is None)

    def _run(self, seed: int, reports: Reports, actions: Actions) -> None:
        """Run an episode in its thread, whose calls of the controller are answered from another one."""

        def controller(reported: Report) -> np.ndarray:
            reports.put(dict(reported))
            action = actions.get()
            if action is None:
                actions.put(None)  # for every further call
                raise EpisodeAbandoned
            return action

        try:
            self._simulate(seed, controller)
        except EpisodeAbandoned:
            pass
        except BaseException as error:  # any error goes to the thread that steps, because nobody sees this one
            reports.put(error)
        reports.put(None)

    def _listen(self) -> Report | None:
        """The next report of the simulator to its controller; None once the simulator has ended."""
        reported = self._reports.get()
        if reported is None or isinstance(reported, BaseException):
            self._thread = None
        if isinstance(reported, BaseException):
            raise RuntimeError(f"the simulator failed: {type(reported).__name__}: {reported}") from reported
        return reported

    def _entries(self, reported: Report) -> TensorDict:
        entries: dict[str, Tensor] = {}
        for name, size in self._sizes.items():
            values = reported.get(name)
            if values is None or np.shape(values) != (size,):
                raise ValueError(
                    f"the simulator reports {name}={values!r}; it must be {size} numbers, as declared in `reports`."
                )
            entries[name] = torch.as_tensor(np.asarray(values, dtype=np.float64))
        return TensorDict(entries, batch_size=self.batch_size)

    def end_episode(self) -> None:
        """Let the simulator finish its episode, or abandon the rest of it; nothing is done where no episode runs."""
        thread = self._thread
        if thread is None:
            return
        self._actions.put(self._action)
        if self._listen() is None:
            return
        self._thread = None
        self._actions.put(None)
        thread.join(self.patience)
        if thread.is_alive():
            raise RuntimeError(
                f"the simulator has not returned {self.patience:g} s after its episode was abandoned; let "
                "EpisodeAbandoned, which its controller raises then, end it."
            )

    def close(self, **kwargs: Any) -> None:
        self.end_episode()
        super().close(**kwargs)


FMI_OK, FMI_ERROR, FMI_FATAL = 0, 3, 4  # the statuses of FMI 2.0 that decide what may be called next


class FMUError(RuntimeError):
    """The FMU has refused a call; the message names the FMU, the call and the time."""


class FMUEnvironment(ForeignSystem):
    """One FMU that is stepped once in a control interval; it reports ``outputs`` and ``exogenous``.

    :class:`RealSystem` makes it the real system of a plant, with ``state=Reading(keys=("outputs",))`` and
    ``exogenous=Reading(keys=("exogenous",))``.

    Args:
        path: the FMU.
        plant: plant that gives the control interval, the ranges of the actions, and draws the exogenous inputs.
        actions: variables of the FMU that take the actions, in the plant's order.
        outputs: variables that are reported.
        exogenous: variables that take the inputs that act on the plant, in its order; empty for an FMU that has its
            own.
        start: function that draws what variables are set to before an episode; None leaves the FMU's own values.
        seed: seed of the first episode, until ``set_seed`` gives another; each later episode adds 1.

    Raises:
        ValueError: if FMPy is not installed, the file is no FMU for co-simulation, or a variable does not exist or the
            number of variables does not fit the plant.
        FMUError: in a reset or step that the FMU refuses.
    """

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
        super().__init__({"outputs": len(outputs), "exogenous": len(plant.inputs)}, plant.actions, seed=seed)
        of_extra("fmpy.simulation", "fmu")
        self._fmpy, self.path, self.plant = of_extra("fmpy", "fmu"), Path(path), plant
        try:
            self._description = self._fmpy.read_model_description(str(self.path))
        except Exception as error:  # FMPy raises whatever its parser meets
            raise ValueError(f"path={self.path} is no FMU that can be read: {error}") from error
        version = self._description.fmiVersion
        if self._description.coSimulation is None or not version.startswith("2."):
            raise ValueError(f"path={self.path} is an FMU of FMI {version}; it must be one of FMI 2 for co-simulation.")
        # Of other types the same references are other variables.
        real = [variable for variable in self._description.modelVariables if variable.type == "Real"]
        self._places = {variable.name: variable.valueReference for variable in real}
        if len(actions) != len(plant.actions):
            count = len(plant.actions)
            raise ValueError(f"actions={tuple(actions)} must name {count} variables, one for each of the plant's.")
        if exogenous and len(exogenous) != (count := len(plant.acting_inputs)):
            raise ValueError(f"exogenous={tuple(exogenous)} must name {count} variables, or none.")
        self._require({"actions": actions, "outputs": outputs, "exogenous": exogenous})
        self._actions, self._outputs, self._exogenous = tuple(actions), tuple(outputs), tuple(exogenous)
        self._start, self._steps = start, 0
        self._fmu: Any = None  # FMPy says no types
        self._status = FMI_OK
        self._folder = self._fmpy.extract(str(self.path))

    def _require(self, names: Mapping[str, Sequence[str]]) -> None:
        for what, variables in names.items():
            if unknown := [name for name in variables if name not in self._places]:
                raise ValueError(
                    f"{what} {unknown} are no variables of type Real in {self.path.name}; it has "
                    f"{', '.join(self._places)}."
                )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        generator = torch.Generator().manual_seed(self._seed)
        self._seed, self._steps = self._seed + 1, 0
        start = {} if self._start is None else dict(self._start(generator))
        self._require({"start": list(start)})
        self._inputs = self.plant.draw_exogenous(1, generator)[0]
        self._free()
        with self._named_errors():
            fmu = self._fmpy.simulation.instantiate_fmu(self._folder, self._description, "CoSimulation")
            self._fmu = fmu
            fmu.setupExperiment(startTime=0.0, stopTime=self.plant.horizon)
            self._set(start)
            fmu.enterInitializationMode()
            self._set(dict(zip(self._exogenous, self._now().tolist(), strict=False)))
            fmu.exitInitializationMode()
            return self._report()

    def _now(self) -> Float[Tensor, " n_z"]:
        return self._inputs[min(self._steps, len(self._inputs) - 1)]

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._fmu is None:
            raise RuntimeError("no episode is running; reset the environment before it is stepped.")
        values = dict(zip(self._actions, tensordict["action"].tolist(), strict=True))
        values |= dict(zip(self._exogenous, self._now().tolist(), strict=False))
        t, dt = self._steps * self.plant.dt, self.plant.dt
        with self._named_errors():
            self._set(values)
            self._fmu.doStep(currentCommunicationPoint=t, communicationStepSize=dt)
            self._steps += 1
            return self._stepped(self._report())

    def _set(self, values: Mapping[str, float]) -> None:
        if values:
            self._fmu.setReal([self._places[name] for name in values], list(values.values()))

    def _report(self) -> TensorDict:
        values = self._fmu.getReal([self._places[name] for name in self._outputs])
        outputs = torch.tensor(list(values), dtype=torch.float64)
        return TensorDict({"outputs": outputs, "exogenous": self._now().clone()}, batch_size=self.batch_size)

    @contextlib.contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Errors of FMPy, which name the call, with the FMU and the time."""
        try:
            yield
        except Exception as error:  # FMPy raises plain exceptions
            self._status = getattr(error, "status", FMI_ERROR)
            t = self._steps * self.plant.dt
            raise FMUError(f"the FMU {self.path.name} refuses a call at t = {t:g} s: {error}") from error

    def _free(self) -> None:
        """Free the FMU as far as FMI 2.0 allows: after an error it may not end its simulation.

        After a fatal error nothing of this library may be called any more; the next episode loads another copy.
        """
        fmu, status, self._fmu, self._status = self._fmu, self._status, None, FMI_OK
        if fmu is None:
            return
        if status == FMI_FATAL:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = self._fmpy.extract(str(self.path))
            return
        for call in (fmu.freeInstance,) if status == FMI_ERROR else (fmu.terminate, fmu.freeInstance):
            with contextlib.suppress(Exception):  # nobody uses this instance any more
                call()

    def close(self, **kwargs: Any) -> None:
        """Free the FMU and what was unpacked of it."""
        self._free()
        shutil.rmtree(self._folder, ignore_errors=True)
        super().close(**kwargs)
