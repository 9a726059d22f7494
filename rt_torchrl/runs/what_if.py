"""What a finished run makes of a question: an episode under any policy and input, and the figures of it."""

import sys
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.evaluation.unseen import UNSEEN_SEED
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # only its type

    from rt_torchrl.runs.loaded_run import LoadedRun


@torch.no_grad()
def simulate(
    run: "LoadedRun",
    policy: nn.Module,
    exogenous: Tensor | None,
    initial_state: Tensor | None,
    *,
    on: str,
    seed: int,
) -> Trajectory:
    """Episodes of a finished run's system; one without a batch dimension if input and state have none.

    Args:
        run: the finished run.
        policy: module of an observation, or one that flies by itself, such as a classical controller.
        exogenous: acting inputs, or all inputs with their previews; None draws those of an episode.
        initial_state: initial states, or those of them that sensors read, with the others at rest; None draws them.
        on: real, or twin for the twin that is most likely to be right, ``run.twin.believed``.
        seed: seed of the draws.

    Raises:
        ValueError: if ``on`` is something else, the policy is no module, or shapes do not fit the plant.
    """
    if on not in ("real", "twin"):
        raise ValueError(f"on={on!r} must be real or twin.")
    if not isinstance(policy, nn.Module | StateFeedback):
        raise ValueError(f"policy={policy!r} must be an nn.Module from observations to actions, or a controller.")
    believed = run.twin.believed
    plant, closure = (run.plant, true_closure(run)) if on == "real" else (believed.plant, believed.closure)
    generator = torch.Generator().manual_seed(seed)
    single = all(given is None or given.dim() == rank for given, rank in ((exogenous, 2), (initial_state, 1)))
    batches = ((exogenous, 3), (initial_state, 2))
    count = max([len(given) for given, rank in batches if given is not None and given.dim() == rank], default=1)
    # States first, as the unseen episodes are drawn, so that the same seed is the same episode.
    drawn = plant.draw_initial_state(count, generator)
    start = drawn if initial_state is None else _start(plant, initial_state, count)
    inputs = plant.draw_exogenous(count, generator) if exogenous is None else _inputs(plant, exogenous, count)
    if isinstance(policy, StateFeedback | ClassicalController):
        flown = policy.fly(start, inputs, closure, plant=plant)
    else:
        flown = Rollout(plant, closure, policy)(start, inputs)
    return flown.each()[0] if single else flown


def true_closure(run: "LoadedRun") -> nn.Module:
    """The real system's closure at the end of the training: a system that wears is not what it was."""
    wear = run.config.wear(run.plant)
    return run.plant.closure if wear is None else wear(run.config.effective().episodes - 1)


def _start(plant: Plant, given: Tensor, count: int) -> Tensor:
    """Given initial states, of which the unread ones may be left out."""
    if given.shape[-1:] == (len(plant.readings),):
        return plant.at_rest(_rows(given, "initial_state", count, (len(plant.readings),)))
    return _rows(given, "initial_state", count, (len(plant.states),))


def _rows(given: Tensor, name: str, count: int, shape: tuple[int, ...]) -> Tensor:
    """A tensor in double precision with a batch dimension of ``count``."""
    if tuple(given.shape[-len(shape) :]) != shape or given.dim() - len(shape) not in (0, 1):
        raise ValueError(f"{name} of shape {tuple(given.shape)} must have the shape {shape}, or a batch of it.")
    rows = given.to(torch.float64).reshape(-1, *shape)
    if len(rows) not in (1, count):
        raise ValueError(f"{name} has {len(rows)} episodes, others {count}; give as many of each, or one.")
    return rows.expand(count, *shape).contiguous()


def _inputs(plant: Plant, exogenous: Tensor, count: int) -> Tensor:
    acting, every = len(plant.acting_inputs), len(plant.inputs)
    n, width = (*exogenous.shape[-2:],) if exogenous.dim() >= 2 else (0, 0)
    if n < 1 or width not in (acting, every):
        names = ", ".join(signal.name for signal in plant.acting_inputs)
        raise ValueError(
            f"exogenous of shape {tuple(exogenous.shape)} must have a row for each control interval and a column for "
            f"each input ({names or 'none'})."
        )
    rows = _rows(exogenous, "exogenous", count, (n, width))
    return rows if width == every else plant.with_previews(rows)


def figures_of(run: "LoadedRun", flown: Trajectory | None) -> dict[str, "Figure"]:
    """Every figure of a finished run by name, with an episode of its own; see :meth:`LoadedRun.figure`."""
    from rt_torchrl import figures  # here, because Matplotlib takes long to load

    snapshot = snapshot_of(run, flown)
    recipe: Any = sys.modules.get(type(run.config).__module__)
    own = getattr(recipe, "plant_figures", None)
    drawn = {"flights": figures.flights(run.physics, {run.live: snapshot.record})} | figures.figures_of(snapshot)
    return drawn | (own(snapshot) if own else {})


@torch.no_grad()
def snapshot_of(run: "LoadedRun", flown: Trajectory | None) -> Snapshot:
    """The state of a finished run, with an episode as the record: by default the first unseen one."""
    live = run.live
    record = simulate(run, run.policy(live), None, None, on="real", seed=UNSEEN_SEED) if flown is None else flown
    record = record if record.states.dim() == 2 else record.each()[0]
    read = record._replace(states=run.physics.at_rest(record.states[..., : len(run.plant.readings)]))
    replay = run.twin.replayed(read)
    process, signals = None, run.physics.acting_inputs
    if run.config.twinning.arm != "model_free" and signals:
        from rt_torchrl.steps.inputs import ExogenousProcess  # here, because it loads TorchRL

        acted = read.exogenous[:, : len(signals)]
        process = ExogenousProcess(acted, dt=run.physics.dt, signals=signals, config=run.config.twinning.exogenous)
    return Snapshot(
        plant=run.physics,
        known=run.physics is run.plant,
        closure=run.twin.believed_law,
        initial_closure=run.initial_closure,
        policies={role: run.policy(role) for role in ("model_free", "model_based")},
        live=live,
        record=read,
        replay=replay,
        large_scale=None if process is None else process.mean,
        realisations=None if process is None else process.sample(5, torch.Generator().manual_seed(0)),
        episodes=run.metrics["episodes"],
    )
