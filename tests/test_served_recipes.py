"""The recipes around the served turbine, in small: they end, and their results say what happened."""

import json

import pytest
from served_plants import free_port
from test_export_recipe import leave_run, recipe

from rt_torchrl.export.program import export_program
from rt_torchrl.runs.configured_plant import physics_of

PACE = 5.0  # a period of 0.1 s, for a machine that does other things too


@pytest.mark.nightly
def test_a_served_turbine_is_trained_on_while_it_operates(tmp_path):
    module = recipe("served_turbine")
    usual = module.Config().defaults()
    config = module.dataclasses.replace(
        usual, quick=True, horizon=60.0, pace=PACE, port=free_port(), threads=1, log_dir=tmp_path, figures=False
    )
    module.main(module.dataclasses.replace(config, untrained=0))
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    versions = [record["version"] for record in metrics["episodes"]]
    assert len(versions) == 3 and versions == sorted(versions) and versions[-1] >= 1.0
    assert all(0.0 < record["late_median"] < 100.0 for record in metrics["episodes"])


@pytest.mark.nightly
def test_an_exported_policy_acts_on_the_served_turbine(tmp_path):
    config, parts = leave_run(tmp_path / "run", "wind_turbine")
    export_program(parts["model_based"], tmp_path / "law.pt2", physics_of(config))
    module = recipe("in_service")
    module.main(
        module.Config(
            policy=tmp_path / "law.pt2",
            trusted=True,
            port=free_port(),
            pace=PACE,
            seconds=20.0,
            log_dir=tmp_path / "found",
        )
    )
    found = json.loads((tmp_path / "found" / "in_service.json").read_text())
    assert found["intervals"] == 40.0 and found["lost_connections"] == 0.0 and found["J_a"] > 0.0


@pytest.mark.nightly
def test_a_short_soak_counts_its_faults_and_handles(tmp_path):
    module = recipe("soak")
    options = {"hours": 0.02, "faults": 10.0, "pace": PACE, "horizon": 30.0, "port": free_port()}
    module.main(module.Config(log_dir=tmp_path, **options))
    found = json.loads((tmp_path / "soak.json").read_text())
    assert found["faults"] and found["safety_events"] > 0
    assert len(found["faults"]) - 1 <= found["faults_logged"] <= len(found["faults"])  # the last may outlive the run
    for process in ("learner", "acting", "server", "relay"):
        assert found["processes"][process]["handles_last"] <= found["processes"][process]["handles_first"] + 2


@pytest.mark.nightly
def test_jitter_is_measured_with_and_without_learning(tmp_path):
    module = recipe("jitter")
    module.main(module.Config(seconds=5.0, turns=1, log_dir=tmp_path))
    found = json.loads((tmp_path / "jitter.json").read_text())
    for kind in ("idle", "learning"):
        assert found[kind]["intervals"] >= 100.0
        assert 0.0 <= found[kind]["median_ms"] <= found[kind]["p99_ms"] <= found[kind]["max_ms"]
    assert found["learner_ratio"] > 0.0


@pytest.mark.nightly
def test_trainings_of_the_same_real_time_are_compared(tmp_path):
    module = recipe("asynchronous")
    options = {"hours": 0.05, "horizon": 60.0, "seeds": (0,), "quick": True, "pace": 10.0}
    module.main(module.Config(log_dir=tmp_path, **options))
    (found,) = json.loads((tmp_path / "asynchronous.json").read_text())["seeds"]
    assert found["synchronous"] > 0.0 and found["asynchronous"] > 0.0 and found["learning_share"] > 0.0


def test_costs_are_summed_over_the_real_time_alone():
    """Two hours: an hour and a half of episodes, half an hour of waiting between, and what comes later is left out."""
    module = recipe("asynchronous")
    config = module.Config(hours=2.0, horizon=1800.0)
    found = module.course([1.0, 2.0, 3.0, 9.0], [1.0] * 4, [1800.0, 0.0, 0.0, 0.0], 5.0, config)
    assert found == 1800.0 * (1.0 + 5.0 + 2.0 + 3.0) / 2.0


@pytest.mark.parametrize(
    ("name", "option", "value"),
    [
        ("served_turbine", "pace", 0.0),
        ("served_turbine", "port", 0),
        ("soak", "hours", 0.0),
        ("soak", "faults", -1.0),
        ("jitter", "period", 0.0),
        ("jitter", "turns", 0),
        ("asynchronous", "pace", -1.0),
        ("asynchronous", "hours", 0.1),
        ("asynchronous", "seeds", ()),
    ],
)
def test_impossible_options_are_refused(name, option, value):
    with pytest.raises(ValueError, match=f"{option}="):
        recipe(name).Config(**{option: value})
