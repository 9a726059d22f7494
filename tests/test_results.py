"""Results of a run in numbers, tables, its bar and its loggers."""

import dataclasses
import json
import struct
import time
from unittest.mock import Mock

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic
from small_runs import SMALL, small_run
from test_algorithm import STEPS, twinning

from rt_torchrl.atomic_file import finite
from rt_torchrl.envs.pendulum.plant import UniformRod
from rt_torchrl.evaluation.real_episodes import RealEpisodes
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.plants.closures import described_weights
from rt_torchrl.runs import progress, results
from rt_torchrl.runs.progress import Progress
from rt_torchrl.runs.results_table import closure_lines, results_table
from rt_torchrl.runs.run import Run
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.systems.real_system import RealSystem
from rt_torchrl.trajectories.engines.parallel import watched_compilation
from rt_torchrl.twinning.algorithm import ReinforcementTwinning
from rt_torchrl.twinning.cloning import of_each_role


def refused(name):
    raise AssertionError(f"{name} is not JSON")


def test_metrics_are_json_where_nothing_was_iterated(tmp_path, capsys):
    nothing = {part: dataclasses.replace(getattr(SMALL, part), iterations=0) for part in ("assimilation", "planner")}
    twinning = dataclasses.replace(SMALL, **nothing)
    options = {"compiled": False, "unseen": 3, "figures": False, "untrained": 0, "episodes": 1}
    metrics = Run(RunConfig(log_dir=tmp_path, twinning=twinning, **options), LinearQuadratic(horizon=2.0)).train()
    assert json.loads((tmp_path / "metrics.json").read_text(), parse_constant=refused) == metrics
    assert metrics["episodes"][0]["J_p"] is None and metrics["episodes"][0]["real_cost"] > 0.0
    assert "J_a model-based" in capsys.readouterr().out


def test_infinite_costs_are_dashes_in_the_table(tmp_path):
    metrics = small_run(tmp_path, episodes=1, figures=False).train()
    unseen = metrics["summary"]["unseen"]
    unseen["J_a_model_free"] = {"mean": float("inf"), "confidence_interval": [1.0, float("inf")]}
    metrics["summary"]["J_a_ratio_model_free"] = float("inf")
    row = next(line for line in results_table(finite(metrics)).splitlines() if "J_a model-free" in line)
    assert row.split()[-4:] == ["-", "[1,", "-]", "-"]


def test_the_table_says_that_the_live_policy_is_on_trial(tmp_path):
    metrics = small_run(tmp_path, episodes=1, figures=False).train()
    found = metrics["summary"]
    assert found["preferred"] == found["live"] and "on trial" not in results_table(metrics)
    found |= {"live": "model_free", "preferred": "model_based"}
    assert "live at the end: model-free, on trial: model-based is expected to cost less" in results_table(metrics)


def judged(seed):
    """Two unseen episodes, whose mean costs depend on the draw."""
    return UnseenEpisodes(LinearQuadratic(horizon=1.0, noise=0.5), 2, seed=seed)


def test_the_better_policy_is_chosen_on_other_episodes_than_it_is_reported_on():
    policies = {"model_based": LinearGain([[0.0, 0.5]]), "model_free": LinearGain([[0.8, 0.5]])}
    algorithm = Mock(spec=ReinforcementTwinning, policies=policies)
    differs = 0
    for seed in range(4):
        unseen = judged(seed)
        other = unseen.validation()
        assert not torch.equal(other.initial_state, unseen.initial_state) and len(other.initial_state) == 2
        # Chosen alike for every seed of the unseen episodes, which play no part in it.
        assert results.better_of(algorithm, unseen) == (cheapest(policies, judged(2_000_000)), "validation episodes")
        differs += cheapest(policies, unseen) != cheapest(policies, other)
    assert differs > 0


def cheapest(policies, episodes):
    """Without the library's rollout: the plant's step in a loop."""
    plant, costs = episodes.plant, {}
    for role, policy in policies.items():
        s, total = episodes.initial_state, 0.0
        for k in range(plant.n_steps):
            t, z = torch.tensor(k * plant.dt), episodes.exogenous[:, k]
            a = plant.actuate(s, policy(s))
            total = total + plant.running_cost(t, s, a, z).mean()
            s = plant.step(t, s, a, z, plant.closure).state
        costs[role] = total
    return min(costs, key=costs.get)


def test_validation_follows_the_wear_of_the_system():
    unseen = judged(0)
    unseen.closure = torch.nn.Identity()
    assert unseen.validation().closure is unseen.closure


@pytest.mark.parametrize(
    "referee, better",
    [
        (Mock(spec=["live", "preferred"], live="model_free", preferred="model_based"), "model_based"),
        (Mock(spec=["live"], live="model_free"), "model_free"),
    ],
)
def test_on_a_real_system_the_better_policy_is_the_preferred_one(referee, better):
    system = Mock(spec=RealSystem, plant=LinearQuadratic(horizon=2.0))
    algorithm = Mock(spec=ReinforcementTwinning, referee=referee)
    assert results.better_of(algorithm, RealEpisodes(system, 2)) == (better, "twin")
    system.rollout.assert_not_called()


def test_clones_are_flown_once_and_other_policies_each():
    """Policies that start with the same weights, or that end as clones, share their flights, with the same numbers."""
    first, second, other = LinearGain([-0.8, -1.1]), LinearGain([-0.8, -1.1]), LinearGain([-0.8, -1.2])
    unseen, flown = UnseenEpisodes(LinearQuadratic(horizon=2.0), 3), []

    def costs(policy):
        flown.append(policy)
        return unseen.control_costs(policy)

    shared = of_each_role({"model_based": first, "model_free": second}, costs)
    assert flown == [first] and torch.equal(shared["model_free"], unseen.control_costs(second))
    flown.clear()
    each = of_each_role({"model_based": first, "model_free": other}, costs)
    assert flown == [first, other] and torch.equal(each["model_free"], unseen.control_costs(other))
    assert not torch.equal(each["model_free"], each["model_based"])


# The closure's weights on the terminal.


def test_true_weights_are_shown_where_they_are_known():
    closure = {"start": {"a": 1.0, "b": 2.0}, "found": {"a": 1.5, "b": 2.5}}
    bare = [["a", "1", "1.5"], ["b", "2", "2.5"]]
    for unknown in ({}, {"true": None}, {"true": {"other": 1.0}}):
        shown = [line.split() for line in closure_lines(closure | unknown)]
        assert shown == [["closure", "weight", "start", "found"], *bare]
    shown = [line.split() for line in closure_lines(closure | {"true": {"a": 1.25}})]
    assert shown[0][-1] == "true" and [line[-1] for line in shown[1:]] == ["1.25", "-"]


def test_units_and_meanings_are_shown_where_the_closure_states_them():
    described = described_weights(UniformRod.guess(0.5))
    closure = {"start": {"mass": 0.5, "length": 0.5}, "found": {"mass": 1.0, "length": 0.75}, "described": described}
    shown = closure_lines(closure)
    assert shown[1].split() == ["mass", "[kg]", "0.5", "1", "mass", "of", "the", "rod"]
    assert shown[2].split() == ["length", "[m]", "0.5", "0.75", "length", "of", "the", "rod"]
    assert described_weights(torch.nn.Linear(1, 1)) == {}


def test_a_meaning_without_a_coefficient_is_refused():
    class Misspelt(UniformRod):
        meanings = {"mas": "mass of the rod"}

    with pytest.raises(ValueError, match="meanings of Misspelt describes mas, which names lacks"):
        Misspelt.guess(1.0)


# The bar of a training says what is under way, and moves while it is.


def test_it_names_each_step_as_it_begins():
    told = []
    twinning().episode(told.append)
    assert told == STEPS and set(progress.WORDS) == {"start", *STEPS}


def test_it_moves_while_a_step_is_under_way(monkeypatch, capsys):
    monkeypatch.setattr(progress, "IN_FILE", 0.05)
    with Progress(3) as bar:
        bar.doing("assimilate")
        time.sleep(1.2)
        bar.episode({"real_cost": 0.25, "live": "model_free"})
        bar.doing("drawing figures")
    shown = capsys.readouterr().err
    assert "starting" not in shown.splitlines()[-1]
    assert "assimilating 0 s" in shown and "assimilating 1 s" in shown and "1/3" in shown
    assert "real 0.25, live model-free; drawing figures" in shown


def test_it_says_when_another_twin_is_believed(capsys):
    record = {"real_cost": 0.25, "live": "model_free", "J_p": 1.0}
    with Progress(4) as bar:
        for episode, believed in enumerate((None, "pitch lag, late by 3", "pitch lag, late by 3", None)):
            bar.episode(record | {"episode": episode, "believed": believed})
    lines = [line.strip() for line in capsys.readouterr().out.splitlines() if "is the likeliest" in line]
    assert lines == [
        "episode 2: the twin with 'pitch lag, late by 3' is the likeliest; J_p and closure are its own",
        "episode 4: the twin alone is the likeliest; J_p and closure are its own",
    ]


def test_it_says_when_the_compiler_is_at_work(capsys):
    with Progress(1) as bar:
        bar._compilation(True)
        bar.doing("plan")
        bar._compilation(False)
    assert "planning 0 s, compiling" in capsys.readouterr().err


def test_compilation_is_watched():
    states = []
    with watched_compilation(states.append):
        # The compiler itself is watched by nobody, and would take twenty seconds.
        torch.compile(lambda x: torch.sin(x) + 1.0, backend="eager")(torch.ones(3, device="cpu"))
    assert states[0] is True and states[-1] is False
    handler = torch._dynamo.callback_handler
    assert not handler.start_callbacks and not handler.end_callbacks


# Weights & Biases and MLflow beside TensorBoard, without a network: what they are told is read back.


BLOCK = 2**15
REAL = "cost/real episode (live policy)"


def trained(folder, logger):
    config = RunConfig(
        episodes=2, log_dir=folder, unseen=3, untrained=0, figures=False, loggers=(logger,), twinning=SMALL
    )
    metrics = Run(config, LinearQuadratic(horizon=2.0)).train()
    return [episode["real_cost"] for episode in metrics["episodes"]]


def content(log):
    """The records of a file of Weights & Biases: a header of 7 bytes, then LevelDB's log, in blocks of 32 KiB."""
    place, found = 7, b""
    while place + 7 <= len(log):
        left = BLOCK - place % BLOCK
        if left < 7:  # no room for the head of a chunk: check sum, length and kind
            place += left
            continue
        (length,) = struct.unpack("<H", log[place + 4 : place + 6])
        found += log[place + 7 : place + 7 + length]
        place += 7 + length
    return found


def test_weights_and_biases_has_the_curves_and_the_options(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb", reason="needs wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    costs = trained(tmp_path / "run", "wandb")
    assert wandb.run is None  # so that the next run of this process begins another one
    wandb.teardown()  # as at the end of the process, which writes the last block
    (file,) = (tmp_path / "run").rglob("*.wandb")
    written = content(file.read_bytes())
    for said in (REAL, "twinning.virtual_episodes", *map(repr, costs)):
        assert said.encode() in written, said


def test_mlflow_has_the_curves_and_the_options(tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow", reason="needs mlflow")
    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    costs = trained(tmp_path / "run", "mlflow")
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'run' / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("linear_quadratic")
    (run,) = client.search_runs([experiment.experiment_id])
    name = "cost/real episode live policy"  # MLflow takes no brackets
    assert [point.value for point in client.get_metric_history(run.info.run_id, name)] == pytest.approx(costs)
    assert run.data.params["twinning.virtual_episodes"] == "2" and run.info.status == "FINISHED"
    assert mlflow.active_run() is None
