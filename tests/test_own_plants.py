"""The two plants of quadrotor.md and heated_room.md are sound, and train as their pages say."""

import json
import re

import fresh_process
import pytest
import torch
from printed_commands import TEXTS, blocks

from rt_torchrl import check_plant, load_run
from rt_torchrl.contract.check import require_controller

PLANTS = {"quadrotor.md": ("Quadrotor", ["LQR"]), "heated_room.md": ("HeatedRoom", ["Thermostat", "PI"])}


def printed(page):
    return "\n".join(blocks(page, "python"))


def parts(page):
    """What the file of a page defines."""
    scope = {"__name__": page.removesuffix(".md")}
    exec(compile(printed(page), f"docs/{page}", "exec"), scope)
    return scope


@pytest.mark.parametrize("page", PLANTS)
def test_its_plant_and_controllers_are_sound(page):
    scope, (name, laws) = parts(page), PLANTS[page]
    plant = scope[name]()
    check_plant(plant, steps=10, traced=False)
    for law in laws:
        require_controller(law, scope[law], plant)
    lines = [line for line in printed(page).splitlines() if line.strip() and not line.strip().startswith("#")]
    assert f"This file has {len(lines)} lines" in TEXTS[page]


def test_the_regulator_of_a_right_data_sheet_holds_the_quadrotor_in_still_air():
    scope = parts("quadrotor.md")
    plant = scope["Quadrotor"]()
    ideal = scope["RotorsAndDrag"](torch.tensor([1.0, 1.0, 0.06]))
    start = plant.draw_initial_state(4, torch.Generator().manual_seed(0))
    flown = scope["LQR"](plant).fly(start, torch.zeros(4, plant.n_steps, 1).double(), ideal)
    target = torch.tensor([2.0, 2.0, 0.0, 0.0, 0.0, 0.0]).double()
    assert (flown.states[:, -1] - target).abs().max() < 0.02


def test_the_thermostat_switches_at_its_edges_alone():
    scope = parts("heated_room.md")
    plant = scope["HeatedRoom"]()
    thermostat = scope["Thermostat"](plant)
    room = torch.tensor([[20.9], [21.3], [21.7], [21.3]]).double()
    on = torch.zeros(1, 1).double()
    powers = []
    for temperature in room:
        power, on = thermostat.law(torch.cat([temperature, temperature]).unsqueeze(0), on)
        powers.append(power.item())
    assert powers == [3000.0, 3000.0, 0.0, 0.0]
    day, night = (plant.occupied(torch.tensor(3600.0 * hour)).item() for hour in (12.0, 3.0))
    assert day > 0.99 and night < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("page", PLANTS)
def test_the_file_of_the_page_trains(page, tmp_path):
    """As a user runs it, with fewer and shorter steps; the run is then read back without the plant."""
    file = tmp_path / page.replace(".md", ".py")
    file.write_text(printed(page).replace("print(check_plant(plant))", ""), encoding="utf-8")
    small = ("--episodes", "2", "--unseen", "6", "--untrained", "0", "--no-figures", "--threads", "1")
    learner = "--twinning.learner"
    few = (f"{learner}.critic-iterations", "20", f"{learner}.actor-iterations", "20")
    done = fresh_process.run(file, *small, *few, "--log-dir", str(tmp_path / "run"), cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text(encoding="utf-8"))["summary"]
    found, true = metrics["closure"]["found"], metrics["closure"]["true"]
    assert all(found[name] == pytest.approx(true[name], rel=1e-8) for name in true)  # measured without noise
    learned = metrics["unseen"]["J_a_model_based"]["mean"]
    classical = [baseline["J_a"]["mean"] for baseline in metrics["unseen"]["baselines"].values()]
    assert learned < max(classical) and metrics["live"] == "model_based"
    assert load_run(tmp_path / "run").plant.name == page.removesuffix(".md")
    assert re.search("take the controller away: .*recipes/export.py", done.stdout)
