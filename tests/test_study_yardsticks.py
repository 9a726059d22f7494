"""Yardsticks of the study: what is kept, and on what they are measured."""

from functools import partial
from pathlib import Path

import pytest
import torch
from handwritten_study import RECIPES

from rt_torchrl.envs.cryogenic_tank.controllers import PIValve
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.evaluation.unseen import UNSEEN_SEED, UnseenEpisodes
from rt_torchrl.runs.shipped_plants import shipped_plants
from rt_torchrl.study import yardsticks
from rt_torchrl.study.results import yardstick_entry
from rt_torchrl.study.yardstick import Yardstick
from rt_torchrl.study.yardsticks import (
    changed_closure,
    classical,
    configured,
    cost_over_episodes,
    least_cost,
    predictive_control,
)


def test_what_is_kept_is_not_computed_again(tmp_path):
    calls = []
    yardstick = Yardstick(tmp_path / "deep" / "x.json", lambda: calls.append(1) or {"costs": [1.0]})
    for _ in range(2):
        assert yardstick.done() == bool(calls)
        assert yardstick.run() == {"costs": [1.0], "arguments": {}}
    assert len(calls) == 1


def test_what_is_of_other_arguments_is_computed_again(tmp_path):
    """The folder of the recipe does not count; what an earlier version has kept has no arguments."""

    def compute(recipe, kind, *, starts):
        return {"starts": starts}

    few, many, elsewhere = (
        Yardstick(tmp_path / "x.json", partial(compute, Path(folder) / "plant.py", PIValve, starts=starts))
        for folder, starts in (("here", 2), ("here", 5), ("there", 2))
    )
    assert few.run()["starts"] == 2 and elsewhere.done() and not many.done()
    with pytest.warns(UserWarning, match=r"x\.json is of other arguments; what it held is computed again"):
        assert many.run()["starts"] == 5
    assert many.done() and not few.done()
    many.path.write_text('{"starts": 5}')
    assert few.done() and many.done()


@pytest.mark.parametrize("left", ["", '{"costs": [1.0', "null"])
def test_a_damaged_yardstick_is_computed_again(tmp_path, left):
    yardstick = Yardstick(tmp_path / "x.json", lambda: {"costs": [1.0]})
    yardstick.path.write_text(left)
    assert not yardstick.done()
    with pytest.warns(UserWarning, match=r"x\.json is damaged; what it held is computed again"):
        assert yardstick.run()["costs"] == [1.0]
    assert yardstick.done()


def test_a_system_with_model_error_ends_as_its_recipe_says():
    turbine, drone, tank = (shipped_plants()[name]() for name in ("wind_turbine", "flapping_wing", "cryogenic_tank"))
    recipes = [RECIPES / f"{name}.py" for name in ("wind_turbine", "flapping_wing", "cryogenic_tank")]
    worn = changed_closure(turbine, recipes[0], ())
    speeds, pitch = torch.tensor([[7.6]], dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    features = torch.cat([speeds, pitch], -1)
    assert worn(features).item() < 0.95 * turbine.closure(features).item()
    # The drone's real body is the plant's own; it is the twin that believes in a lighter one.
    assert changed_closure(drone, recipes[1], ()) is None
    fouled = changed_closure(tank, recipes[2], ("--episodes", "11"))
    ratio = fouled.log_coefficients.exp() / tank.closure.log_coefficients.exp()
    assert ratio.tolist() == pytest.approx([1.0, 0.98**10, 1.0])


def test_a_classical_controller_is_judged_on_what_its_twin_does_not_know(monkeypatch):
    monkeypatch.setattr(yardsticks, "missing_for_compilation", lambda: "a compiler")
    short = ("--horizon", "7500", "--command", "drop", "--end-weight", "0")
    size = {"unseen": 3, "episodes": 2, "evaluations": 3, "changed": False}
    as_known, real = (
        classical(RECIPES / "cryogenic_tank.py", (*short, *further), PIValve, **size)
        for further in ((), ("--unknown", "bias_15"))
    )
    assert "changed" not in real  # model error would be another real system
    plant = configured(RECIPES / "cryogenic_tank.py", (*short, "--unknown", "bias_15")).plant()
    episodes = UnseenEpisodes(plant, 3)
    valve = PIValve(configured(RECIPES / "cryogenic_tank.py", short).plant(), tuple(real["gains"].values()))
    assert real["costs"] == pytest.approx(episodes.judge(episodes.fly_baseline(valve)).control_costs.tolist())
    assert real["costs"] != pytest.approx(as_known["costs"], rel=0.01)


def test_a_plan_on_training_episodes_is_judged_on_unseen_ones(monkeypatch):
    monkeypatch.setattr(yardsticks, "missing_for_compilation", lambda: "a compiler")
    system = RECIPES / "wind_turbine.py", ("--horizon", "5", "--policy", "paper")
    planned = {n: cost_over_episodes(*system, unseen=4, counts=(2, 3), iterations=n) for n in (0, 8)}
    plant = configured(*system).plant()
    start = plant.make_policy(torch.Generator().manual_seed(UNSEEN_SEED))
    assert planned[0]["costs"] == pytest.approx([UnseenEpisodes(plant, 4).control_costs(start).mean().item()] * 2)
    assert planned[8]["values"] == [2, 3] and max(planned[8]["costs"]) < planned[0]["costs"][0]


def test_the_limit_is_below_predictive_control_on_the_first_unseen_episodes(monkeypatch):
    monkeypatch.setattr(yardsticks, "missing_for_compilation", lambda: "a compiler")
    system = RECIPES / "wind_turbine.py", ("--horizon", "15", "--policy", "paper")
    best = least_cost(*system, unseen=4, count=2, iterations=3000)
    planned = predictive_control(*system, unseen=4, count=2)
    assert all(low < high for low, high in zip(best["costs"], planned["costs"], strict=True))
    assert len(best["costs"]) == 2 and best["details"]["projected_gradient"] < 1e-2
    assert best["milliseconds"] is None and planned["milliseconds"]["median"] > 0.0
    episodes = UnseenEpisodes(configured(*system).plant(), 4).first(2)
    jonkman = episodes.judge(episodes.fly_baseline(JonkmanController(episodes.plant)))
    assert set(best["merit"]) == set(jonkman.merit) and max(best["costs"]) < jonkman.control_costs.max()
    entry = yardstick_entry("mpc", planned)
    assert entry.milliseconds == planned["milliseconds"]["median"] and entry.over(yardstick_entry("limit", best)) > 1.0


def test_what_a_recipe_does_not_say_is_refused():
    with pytest.raises(ValueError, match="no model predictive control with the options --command drop"):
        predictive_control(RECIPES / "cryogenic_tank.py", ("--command", "drop", "--horizon", "3000"), unseen=2, count=2)
    with pytest.raises(ValueError, match="does not say how the limit is computed"):
        least_cost(RECIPES / "pendulum.py", (), unseen=2, count=2, iterations=1)


def test_yardsticks_are_measured_on_the_plant_of_the_trainings():
    short = configured(RECIPES / "flapping_wing.py", ("--quick", "--horizon", "1.25"))
    assert short.plant().horizon == pytest.approx(1.25) and short.episodes == 3
    for name, default in shipped_plants().items():
        if (RECIPES / f"{name}.py").exists() and name != "cascaded_tanks":  # whose recipe trains on a record alone
            assert configured(RECIPES / f"{name}.py", ()).plant().extra_repr() == default().extra_repr()
