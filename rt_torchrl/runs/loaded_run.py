"""A finished run in code: its plant, policies, closure and results, what-if episodes and figures."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.evaluation.law import asked_features
from rt_torchrl.evaluation.unseen import UNSEEN_SEED
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.options import read_options
from rt_torchrl.plants.plant import Plant
from rt_torchrl.runs.command_line import load_recipe
from rt_torchrl.runs.metrics import on_the_twin, read_metrics
from rt_torchrl.runs.run_config import RunConfig, plant_of, require_plant
from rt_torchrl.runs.run_folder import load_tensors
from rt_torchrl.runs.settings import BESIDE, class_of, read_settings, require_config
from rt_torchrl.steps.config import Role
from rt_torchrl.steps.hypotheses.ensemble import TwinEnsemble, make_twin
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Trajectory, TwinFlight, until_end
from rt_torchrl.trajectories.twin import DigitalTwin

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # only its type: who reads weights needs no Matplotlib


@dataclass(frozen=True, kw_only=True)
class LoadedRun:
    """A finished run as :func:`load_run` reads it from its folder, on the CPU.

    Args:
        config: options of the run, as they were asked for.
        plant: the real system in simulation, newly made.
        physics: physics of the twin, which policies are made for; the plant itself unless the twin is wrong about it.
        policies: trained policies by role: ``model_based`` and ``model_free``. Model predictive control in the place of
            ``model_based`` plans on ``closure``.
        closure: trained closure of the twin alone, which a hypothesis that explains the records better does not share.
        initial_closure: closure that the training started from.
        twin: the twin with the trained closure; with hypotheses a :class:`TwinEnsemble` with their trained closures and
            weights, whose ``twins`` are those of the hypotheses by name. ``twin.believed`` is the twin that is most
            likely to be right, with its ``plant`` and its ``closure``, and ``twin.hypothesis`` the name of what it has
            beside the plant, None for nothing.
        folder: folder of the run.
    """

    config: RunConfig
    plant: Plant
    physics: Plant
    policies: dict[str, nn.Module]
    closure: nn.Module
    initial_closure: nn.Module
    twin: DigitalTwin
    folder: Path

    @property
    def metrics(self) -> dict[str, Any]:
        """Content of ``metrics.json``: ``episodes`` and ``summary``.

        Raises:
            ValueError: if the folder holds no ``metrics.json``, or a damaged one.
        """
        return read_metrics(self.folder)

    @property
    def live(self) -> Role:
        """Role of the policy that is live at the end."""
        role: Role = self.metrics["summary"]["live"]
        return role

    @property
    def _only_on_the_twin(self) -> bool:
        """Whether nobody knows the true closure of the real system."""
        return on_the_twin(self.metrics["summary"]["unseen"])

    @torch.no_grad()
    def simulate(
        self,
        policy: nn.Module,
        exogenous: Tensor | None = None,
        initial_state: Tensor | None = None,
        *,
        on: str = "real",
        seed: int = 0,
    ) -> Trajectory:
        """Fly a policy on the real system in simulation, or on the twin.

        The twin is ``twin.believed``, that of the likeliest hypothesis. States of the trajectory are those of the plant
        that flies, of which sensors read the first ones; its cost is ``control_cost(run.twin.believed.plant, flown)``.

        Args:
            policy: policy of an observation, such as ``run.policy("model_based")``, or a :class:`ClassicalController`.
            exogenous: exogenous inputs, ``*batch n n_z``, a row for each control interval; None draws an episode.
            initial_state: states to start from, ``*batch n_s``, or those of them that sensors read; None draws them.
            on: real for the system with its true closure, or twin for the twin that is most likely to be right.
            seed: seed of what is drawn.

        Raises:
            ValueError: if ``on`` is something else, it is real and nobody knows the true closure, or shapes do not fit
                the plant.
            DivergenceError: if the system diverges.
        """
        if on not in ("real", "twin"):
            raise ValueError(f"on={on!r} must be real or twin.")
        if not isinstance(policy, nn.Module | StateFeedback):
            raise ValueError(f"policy={policy!r} must be an nn.Module from observations to actions, or a controller.")
        if on == "real" and self._only_on_the_twin:
            raise ValueError(
                "nobody knows the true closure of this run's real system, so that on='real' cannot be simulated; give "
                "on='twin'."
            )
        believed = self.twin.believed
        plant, closure = (self.plant, self.plant.closure) if on == "real" else (believed.plant, believed.closure)
        generator = torch.Generator().manual_seed(seed)
        ranks = ((exogenous, 2), (initial_state, 1))
        batches = [len(given) for given, rank in ranks if given is not None and given.dim() > rank]
        count = max(batches, default=1)
        # States first, as the unseen episodes are drawn, so that the same seed is the same episode.
        start = plant.draw_initial_state(count, generator)
        if initial_state is not None:
            start = _rows("initial_state", initial_state, 1, count, (len(plant.readings), len(plant.states)))
            start = start if start.shape[-1] == len(plant.states) else plant.at_rest(start)
        if exogenous is None:
            inputs = plant.draw_exogenous(count, generator)
        else:
            inputs = _rows("exogenous", exogenous, 2, count, (len(plant.acting_inputs), len(plant.inputs)))
            inputs = inputs if inputs.shape[-1] == len(plant.inputs) else plant.with_previews(inputs)
        if isinstance(policy, StateFeedback | ClassicalController):
            flown = policy.fly(start, inputs, closure, plant=plant)
        else:
            flown = Rollout(plant, closure, policy)(start, inputs)
        flown = TwinFlight(*flown) if on == "twin" else flown
        return flown if batches else flown.each()[0]

    def figure(self, name: str, flown: Trajectory | None = None) -> "Figure":
        """A figure of the training by name, as ``figures/`` of the run folder has it; see :meth:`figure_names`.

        Args:
            name: name of the figure, such as states, actions, learning_curves or power_and_speed.
            flown: episode that figures of an episode show, from :meth:`simulate`; None for an episode that no training
                has seen, under the live policy and without exploration, on the twin where nobody knows the real system.

        Raises:
            ValueError: if this run has no such figure.
        """
        drawn = self._figures(flown)
        if name not in drawn:
            raise ValueError(f"figure {name!r} does not exist in this run; choose one of {', '.join(sorted(drawn))}.")
        return drawn[name]

    def figure_names(self) -> Sequence[str]:
        """Names that :meth:`figure` takes."""
        return sorted(self._figures(None))

    def policy(self, role: str) -> nn.Module:
        """The trained policy of a role.

        Raises:
            ValueError: if there is none.
        """
        if role not in self.policies:
            known = " or ".join(sorted(self.policies))
            raise ValueError(f"role={role!r} does not exist in this run; choose {known}, or run.live.")
        return self.policies[role]

    def _figures(self, flown: Trajectory | None) -> dict[str, "Figure"]:
        """Every figure of a finished run by name, with an episode of its own; see :meth:`LoadedRun.figure`."""
        from rt_torchrl import figures  # here, because Matplotlib takes long to load

        snapshot = self._snapshot(flown)
        where = "on the twin" if snapshot.on_the_twin else ""
        flights = figures.flights(self.physics, {self.live: snapshot.record}, where=where)
        return {"flights": flights} | figures.figures_of(snapshot) | self.config.plant_figures(snapshot)

    @torch.no_grad()
    def _snapshot(self, flown: Trajectory | None) -> Snapshot:
        """The state of a finished run, with an episode as the record: by default the first unseen one."""
        live = self.live
        if flown is None:
            place = "twin" if self._only_on_the_twin else "real"
            flown = self.simulate(self.policy(live), seed=UNSEEN_SEED, on=place)
        on_the_twin, record = isinstance(flown, TwinFlight), flown
        record = record if record.states.dim() == 2 else record.each()[0]
        inputs, record = record.exogenous, until_end(self.twin.believed.plant if on_the_twin else self.plant, record)
        read = record._replace(states=self.physics.at_rest(record.states[..., : len(self.plant.readings)]))
        n = len(read.actions)
        segment = self.metrics["summary"]["twin"]["segment"]
        process = None
        if self.config.twinning.arm != "model_free":
            from rt_torchrl.steps.inputs import ExogenousProcess  # here, because it loads TorchRL

            signals, given = self.physics.acting_inputs, self.config.twinning.exogenous
            process = ExogenousProcess.of(inputs[:, : len(signals)], signals=signals, config=given)
        return Snapshot(
            plant=self.physics,
            true_closure=None if self._only_on_the_twin else self.plant.closure,
            closure=self.twin.believed_law,
            initial_closure=self.initial_closure,
            policies={role: self.policy(role) for role in ("model_free", "model_based")},
            live=live,
            record=read,
            replay=self.twin.replayed(read, segment),
            segment=segment,
            large_scale=None if process is None else process.mean[:n],
            realisations=None if process is None else process.sample(5, torch.Generator().manual_seed(0))[:, :n],
            episodes=self.metrics["episodes"],
            simulated="flight on the twin" if on_the_twin else "one flight",
            on_the_twin=on_the_twin,
            features=asked_features(self.twin, [read]),
        )


def load_run(
    folder: Path | str, recipe: Path | str | type[RunConfig] | None = None, *, plant: Plant | None = None
) -> LoadedRun:
    """Read the plant, the policies and the closure of a finished run back from its folder.

    ``config.json`` names the recipe that made the run, and that recipe is imported, which runs its code. A recipe that
    lies in the run folder itself is not imported unless it is given here, nor is a module whose file is not there,
    unless it is one of this library.

    Args:
        folder: the run folder, with ``config.json`` and ``weights.pt``.
        recipe: the recipe, if it has moved or the run does not name it: its file, or the class itself; by default the
            recipe that the run names.
        plant: the plant of the run, if the recipe's ``Config`` has no method ``plant()`` that makes it.

    Raises:
        ValueError: if the folder holds no finished run, its recipe is not found, or the present recipe cannot rebuild
            the run.
    """
    folder = Path(folder)
    settings = read_settings(folder)
    config_class = class_of(folder, settings) if recipe is None else config_class_of(recipe)
    if not (folder / "weights.pt").is_file():
        raise ValueError(
            f"the run in {folder} has no weights.pt: it is not finished. Go on with it by --resume; Ctrl-C ends it "
            "and leaves the weights of the episodes done."
        )
    weights = load_tensors(folder / "weights.pt")
    config, plant = _rebuilt(folder, settings, config_class, plant)
    physics = config.believed() or plant
    generator = torch.Generator().manual_seed(config.seed)
    untrained = config.make_policies(physics, generator)
    closure = config.make_closure(physics, generator)
    policies: dict[str, nn.Module] = dict(config.acting_policies(untrained, physics, closure).items())
    initial = copy.deepcopy(closure)
    for role, part in {**policies, "closure": closure}.items():
        try:
            part.load_state_dict(weights[role])
        except (RuntimeError, KeyError) as error:
            raise ValueError(f"weights of {role!r} in {folder / 'weights.pt'} do not fit: {error}") from error
    twin = DigitalTwin(physics, closure)
    if "hypotheses" in weights:
        twin = make_twin(physics, closure, config.twinning.hypotheses)
        try:
            if not isinstance(twin, TwinEnsemble):
                raise ValueError(f"plant {physics.name!r} suspects nothing any more.")
            twin.load_hypotheses(weights["hypotheses"])
        except ValueError as error:
            raise ValueError(f"the hypotheses in {folder / 'weights.pt'} do not fit: {error}") from error
    twin.noise = weights.get("noise", twin.noise)
    return LoadedRun(
        config=config,
        twin=twin,
        plant=plant,
        physics=physics,
        closure=closure,
        policies=policies,
        initial_closure=initial,
        folder=folder,
    )


def _rebuilt(
    folder: Path, settings: dict[str, Any], config_class: type[RunConfig], plant: Plant | None
) -> tuple[RunConfig, Plant]:
    """The configuration and the plant that a run's settings describe; a given plant is taken as it is."""
    options = {key: value for key, value in settings.items() if key not in BESIDE}
    try:
        config = read_options(config_class, options)
        plant = plant_of(config) if plant is None else plant
    except (ValueError, TypeError, OSError) as error:
        raise ValueError(f"{folder / 'config.json'} cannot be carried out: {error}") from error
    require_plant("plant", plant)
    name = settings["plant"]
    if plant.name != name:
        raise ValueError(f"{folder} is a run of plant {name!r}, the recipe is of {plant.name!r}; use the run's recipe.")
    return config, plant


def config_class_of(recipe: Path | str | type[RunConfig]) -> type[RunConfig]:
    """The configuration class of a recipe, given as the class or as its file.

    Raises:
        ValueError: if there is no such file, or it defines no recipe; see :func:`load_recipe`.
    """
    if isinstance(recipe, type):
        return require_config(recipe, recipe.__qualname__)
    return load_recipe(Path(recipe)).Config


def _rows(name: str, given: Tensor, rank: int, count: int, widths: Sequence[int]) -> Tensor:
    """What is given of one episode or of each, in double precision with a batch dimension of ``count``."""
    rows = given if given.dim() > rank else given[None]
    if rows.dim() != rank + 1 or 0 in rows.shape[:-1] or rows.shape[-1] not in widths or len(rows) not in (1, count):
        columns = " or ".join(map(str, dict.fromkeys(widths)))
        raise ValueError(
            f"{name} of shape {tuple(given.shape)} must have {rank} dimensions, the last of {columns}, or a batch of "
            f"{count} of them."
        )
    return rows.to(torch.float64).expand(count, *rows.shape[1:]).contiguous()
