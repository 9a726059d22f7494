"""The room between policies planned on a twin that does not know the real system, and the optimum on that system."""

import dataclasses
import json
import os

import pytest
from test_export_recipe import recipe

from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.study.room import Room, require_page, room_table, write_into
from rt_torchrl.study.training import Training
from rt_torchrl.study.yardstick import Yardstick

ROOMY = Room(system="pitch", oracle=0.05, planned=[0.2, 0.1, 0.3], said=[0.04, 0.05, 0.06], classical={"PD": 0.07})

HELPED = dataclasses.replace(ROOMY, helped=[0.06, 0.055, 0.3], paid=[1.0, 2.0, 3.0], helped_paid=[0.5, 0.4, 0.6])


def test_the_gap_is_that_of_the_median_over_the_least_cost_that_was_found():
    assert ROOMY.gap == pytest.approx(3.0)
    beyond = Room(system="", oracle=0.5, planned=[0.4, 0.41], said=[0.4, 0.4], classical={})
    assert beyond.best == 0.4 and beyond.gap == pytest.approx(0.0125)
    shown = room_table([ROOMY, beyond]).splitlines()
    assert shown[2] == "| pitch | 0.05 | 0.2 (0.1 … 0.3) | 300.0 % | 0.05 | PD 0.07 | yes |"
    assert shown[3].startswith("| as the twin | 0.4 |") and shown[3].endswith("| 1.2 % | 0.4 | – | no room |")


def test_a_page_takes_each_table_once(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# Page\n\ntext\n")
    for text in ("first", "second"):
        write_into(page, "turbine", text)
        write_into(page, "drone", text)
    assert page.read_text().count("second") == 2 and "first" not in page.read_text()
    assert page.read_text().startswith("# Page\n\ntext\n\n<!-- turbine -->")
    with pytest.raises(ValueError, match=r"gone\.md cannot be read"):
        write_into(tmp_path / "gone.md", "drone", "text")


@pytest.mark.parametrize("name", ["unknown", "worth"])
def test_a_page_that_cannot_be_written_is_refused_before_any_work(name, tmp_path, monkeypatch):
    made, page = recipe(name), tmp_path / "pages" / "page.md"
    options = {"plant": "wind_turbine"} if name == "unknown" else {"plants": ("wind_turbine",)}
    config = made.Config(**options, folder=tmp_path / "kept", page=page)
    worked = []
    monkeypatch.setattr(made, "on_this_machine", lambda tasks, jobs: worked.append(tasks))
    with pytest.raises(ValueError, match=r"page.md cannot be read .*; give a text that exists"):
        made.main(config)
    page.parent.mkdir()
    page.write_bytes(b"\xff")
    with pytest.raises(ValueError, match=r"page.md cannot be read .*; give a text that exists"):
        made.main(config)
    page.write_text("# Page\n")
    with monkeypatch.context() as patched:  # to the superuser, who may run this, no folder is closed
        patched.setattr(os, "access", lambda path, mode: path != page.parent)
        with pytest.raises(ValueError, match=r"page.md cannot be written, because the folder .*pages cannot"):
            require_page(page)
    require_page(page)
    require_page(None)
    assert not worked and page.read_text() == "# Page\n"


@pytest.mark.parametrize(
    ("options", "system", "unknown"),
    [
        (("wind_turbine",), "inflow+pitch", ("inflow", "pitch")),
        (("flapping_wing", "--task", "hop"), "plane_6.3", ("plane_6.3",)),
        (("cryogenic_tank", "--unseen", "4"), "nothing", ()),
    ],
)
def test_trainings_and_optimum_are_of_the_recipe_with_the_unknown_system(options, system, unknown, tmp_path):
    made = recipe("unknown")
    config = from_command_line(made.Config, [*options, "--seeds", "2", "--folder", str(tmp_path)])
    assert config.rows()[0] == "nothing" and len(config.rows()) == 1 + len(made.SYSTEMS[config.plant])
    trainings = config.trainings(system)
    assert [training.seed for training in trainings] == [0, 1]
    found = from_command_line(load_recipe(config.recipe).Config, trainings[1].arguments())
    assert found.unknown == unknown and found.twinning.arm == "model_based" and found.episodes == 3
    optimum = config.optimum(system)
    assert found.unseen == optimum.compute.keywords["unseen"]
    # Optima of different numbers of episodes are kept apart.
    assert optimum.path.name == ("oracle-4.json" if "--unseen" in options else "oracle.json")


def test_a_row_is_made_of_what_is_kept(tmp_path, monkeypatch):
    made = recipe("unknown")
    config = made.Config(plant="wind_turbine", systems=("pitch",), seeds=3, folder=tmp_path, page=tmp_path / "page.md")
    (tmp_path / "page.md").write_text("# Page\n")

    def metrics(training):
        helped = training.folder.name.endswith("hypotheses")
        assert training.options[training.options.index("--twinning.hypotheses.which") + 1] == (
            "automatic" if helped else "none"
        )
        costs, paid = (HELPED.helped, HELPED.helped_paid) if helped else (HELPED.planned, HELPED.paid)
        unseen = {"J_a_model_based": {"mean": costs[training.seed]}, "baselines": {"PD": {"J_a": {"mean": 0.07}}}}
        summary = {"unseen": unseen, "cost_of_learning": {"sum": paid[training.seed]}}
        said = ROOMY.said[training.seed]
        return {"summary": summary, "episodes": [{"J_a_plan": 1.0}, {"J_a_plan": said}]}

    monkeypatch.setattr(Training, "metrics", metrics)
    monkeypatch.setattr(Yardstick, "run", lambda yardstick: {"J_a": {"mean": 0.05}})
    monkeypatch.setattr(made, "on_this_machine", lambda tasks, jobs: None)
    made.main(config)
    kept = json.loads((config.kept / "room.json").read_text())["rows"]
    assert kept == [vars(HELPED) | {"gap": pytest.approx(3.0)}]
    assert room_table([HELPED]) in (tmp_path / "page.md").read_text()


def test_a_row_with_hypotheses_says_what_they_are_worth():
    cells = HELPED.cells()
    assert cells[:7] == ROOMY.cells() and cells[7:] == ["0.06 (0.055 … 0.3)", "20.0 %", "2, 0.5"]
    assert "with hypotheses" in room_table([HELPED]) and "with hypotheses" not in room_table([ROOMY])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"systems": ("gust",)}, "gust does not exist"),
        ({"systems": ("anemometer_low+anemometer_high",)}, "both change the anemometer"),
        ({"task": "hop"}, "task='hop' is a task of the drone"),
        ({"seeds": 0}, "seeds=0 must be at least 1"),
        ({"unseen": 1}, "unseen=1 must be at least 2"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        recipe("unknown").Config(plant="wind_turbine", **options)
