"""What twinning is worth: the plan of arms and systems, regret, alarms and the page, from results by hand."""

import dataclasses
import json

import numpy as np
import pytest
from handwritten_study import EPISODES, finish, recipe

from rt_torchrl.study.arms import Arm, SystemResult, false_alarms, missed_alarms, missed_errors
from rt_torchrl.study.results import Entry
from rt_torchrl.study.worth import ablation_section, alarm_section, findings_page, verdict

PAID = [[4.0, 3.0, 1.0], [4.0, 2.0, 1.0]]


def arm(name, shift=0.0, *, alarms=(), wrong=None, curves=(), paid=PAID):
    ruler = np.random.default_rng(0).random((1, 40))
    costs = 1.0 + 0.1 * ruler + shift * np.array([[1.0], [1.2]])
    entry = Entry(name=name, costs=costs, merit={}, curves=list(curves))
    wrong = [[True] * len(seed) for seed in alarms] if wrong is None else wrong
    return Arm(entry=entry, paid=paid, alarms=list(alarms), wrong=wrong)


def system(arms, name="pitch"):
    oracle = Entry(name="oracle", costs=arm("oracle").entry.costs[:1], merit={})
    return SystemResult(case="wind turbine", system=name, oracle=oracle, arms=arms)


def test_regret_is_what_was_paid_less_what_the_oracle_would_have_paid():
    found = arm("twinning", paid=[[4.0, 3.0, 1.0], [4.0, 2.0]])
    np.testing.assert_allclose(found.regret(0.5), [[3.5, 6.0], [3.5, 5.0]])
    assert found.sums() == [8.0, 6.0]


def test_alarms_are_counted_where_they_could_be_wrong():
    alarms = [[False] * 6 + [True], [False, True, False, False, False, False, False]]
    nominal = arm("twinning", alarms=alarms)
    assert (false_alarms(nominal).episodes, false_alarms(nominal).wrong) == (14, 2)
    # After five episodes: two of each seed, of which one has no gap and one an alarm.
    curves = [[9.0] * 5 + [1.2, 1.2], [9.0] * 5 + [1.05, 1.3]]
    unknown = missed_alarms(arm("twinning", alarms=alarms, curves=curves), 1.0)
    assert (unknown.episodes, unknown.wrong) == (3, 2)
    assert unknown.words() == "2 of 3 (66.7 %)"
    # In one of these the twin is right about a policy that a poor minimum holds.
    wrong = [[True] * 6 + [False], [False] * 6 + [True]]
    blamed = missed_errors(arm("twinning", alarms=alarms, wrong=wrong, curves=curves), 1.0)
    assert blamed.words() == "2 of 2 (100.0 %)"


def test_the_alarm_section_adds_the_systems():
    up, down = [[True] * 7], [[False] * 7]
    curves = [[1.5] * 7]
    page = alarm_section(
        [
            system([arm("twinning", alarms=down, curves=curves), arm("model-free")], name=""),
            system([arm("twinning", alarms=up, curves=curves)]),
            system([arm("twinning", alarms=down, curves=curves)], "inflow"),
        ]
    )
    counts = "0 of 7 (0.0 %) | 2 of 4 (50.0 %) | 2 of 4 (50.0 %)"
    assert f"| twinning | {counts} |" in page and "model-free" not in page
    assert "- false: 0 of 7 (0.0 %); at most 5 % are wanted: yes." in page
    assert "- missed: 2 of 4 (50.0 %); at most 5 % are wanted: no." in page


def test_a_part_is_worth_what_its_absence_costs():
    assert verdict([(1.3, 1.0), (1.0, 1.0)]).startswith("in 1 of 2 rows")
    assert verdict([(1.01, 0.99)]) == "worth nothing in any of 1 rows"
    known = [system([arm("twinning"), arm("without hypotheses", 1.0)])]
    page = ablation_section(known, {"without hypotheses": "hypotheses", "without the belief": "the belief"})
    assert "| hypotheses | wind turbine, pitch | 2." in page and "the referee" not in page
    assert ablation_section([system([arm("model-free")])], {"without hypotheses": "hypotheses"}) == ""


def test_the_page_says_who_is_better_with_confidence():
    arms = [arm("twinning"), arm("model-based", 1.0, paid=[[1.0], [1.0]]), arm("other")]
    page = findings_page([system(arms)], {}, "uv run recipes/worth.py")
    assert "twinning ends at the least cost" in page and "model-based has paid least on the way, 1." in page
    assert "better than model-based; neither better nor worse than other" in page
    assert "### wind turbine, pitch" in page and page.startswith("`uv run recipes/worth.py`")


def test_what_does_not_exist_is_refused():
    config = recipe("worth").Config
    with pytest.raises(ValueError, match="plants: moon does not exist; choose among wind_turbine"):
        config(plants=("moon",))
    with pytest.raises(ValueError, match="arms: magic does not exist"):
        config(arms=("magic",))
    with pytest.raises(ValueError, match="arms: predictive control is on none of cryogenic_tank"):
        config(plants=("cryogenic_tank",), arms=("predictive control",))
    with pytest.raises(ValueError, match=r"systems: bias_5 is on none of wind_turbine; choose nothing, or names among"):
        config(plants=("wind_turbine",), systems=("bias_5",))
    for plants in (("wind_turbine",), ("all",)):
        with pytest.raises(ValueError, match=r"all and pitch both change the pitch drive; give one"):
            config(plants=plants, systems=("inflow+pitch", "all+pitch"))
    for name in ("seeds", "episodes"):
        with pytest.raises(ValueError, match=f"{name}=0 must be at least 1"):
            config(**{name: 0})


def test_every_arm_is_a_training_that_its_recipe_can_make(tmp_path):
    from rt_torchrl.runs.command_line import from_command_line, load_recipe

    worth = recipe("worth")
    config = worth.Config(systems=("nothing", "pitch", "delay", "bias_5"), seeds=1, folder=tmp_path)
    planned = {row: config.trainings(*row) for row in config.rows()}
    folders = {training.folder for groups in planned.values() for (training,) in groups.values()}
    assert len(folders) == 2 * 10 + 3 * 2 * 9  # predictive control on the turbine alone
    read = [("wind_turbine", "pitch", name) for name in worth.ARMS]
    read += [(case, system, "twinning") for case, system in (("hop", "delay"), ("cryogenic_tank", "bias_5"))]
    for case, system_name, name in read:
        (training,) = planned[case, system_name][name]
        made = from_command_line(load_recipe(training.recipe).Config, training.arguments())
        assert made.unknown == (system_name,)
        assert made.twinning.arm == ("model_free" if "free" in name else training.arm)
        if name == "twinning":
            assert made.twinning.referee.rule == "expected_cost" and made.twinning.hypotheses.which == "automatic"


def test_the_page_is_written_from_what_is_kept(tmp_path):
    """A study of two arms from results written by hand: nothing is computed."""
    worth = recipe("worth")
    options = {"plants": ("flapping_wing",), "systems": ("nothing", "delay"), "arms": ("twinning", "model-based")}
    config = worth.Config(**options, seeds=2, episodes=3, unseen=EPISODES, folder=tmp_path / "kept")
    for row in config.rows():
        for training in [one for group in config.trainings(*row).values() for one in group]:
            path = finish(training).folder / "metrics.json"
            metrics = json.loads(path.read_text())
            metrics["episodes"][0]["start_cost"] = 7.0
            for episode in metrics["episodes"]:
                episode |= {"real_cost": episode["J_a_unseen"], "alarm": 0.0}
            metrics["summary"]["unseen"]["costs"]["PD"] = [1.5] * EPISODES
            metrics["summary"]["unseen"]["baselines"] = {"PD": {"merit": {"m [m]": {"mean": 1.0}}}}
            path.write_text(json.dumps(metrics))
        optimum = config.optimum(*row)
        optimum.path.parent.mkdir(parents=True, exist_ok=True)
        optimum.path.write_text(json.dumps({"costs": [0.9] * EPISODES, "merit": {"m [m]": {"mean": 1.0}}}))
    assert all(task.done() for task in config.tasks()) and len(config.tasks()) == 2 * (1 + 2 * 2)
    page = worth.write(config).read_text()
    assert "### flapping wing, as the twin" in page and "### flapping wing, delay" in page
    # 7 of the start, then 5, 1.05 and 1.
    assert page.count("| 14.05 |") == 4 and "| PD |" in page
    assert "--arms twinning model-based --seeds 2 --episodes 3" in page
    numbers = json.loads((config.folder / "worth.json").read_text())["systems"]
    assert numbers[1]["arms"]["twinning"]["paid"] == [[7.0, 5.0, 1.05, 1.0]] * 2
    assert (config.folder / "regret_flapping_wing_delay.png").stat().st_size > 0
    (config.trainings("flapping_wing", "delay")["model-based"][0].folder / "metrics.json").unlink()
    config.optimum("flapping_wing", "nothing").path.unlink()
    rest = worth.write(config).read_text()
    assert "### flapping wing, as the twin" not in rest and "| model-based | 1 |" in rest and "| twinning | 2 |" in rest
    with pytest.raises(ValueError, match="holds no finished training and oracle of this study"):
        worth.write(dataclasses.replace(config, folder=tmp_path / "none"))
