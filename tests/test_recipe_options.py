"""Options of the recipes that are out of range are refused by their own names."""

import dataclasses
import math
from pathlib import Path

import pytest
from test_export_recipe import RECIPES, recipe

from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.runs.loaded_run import config_class_of

HEADER = "! TurbSim\n"
LINE = "{time:.2f} {speed:g} 0 0 0 0 0 0\n"


def made(plant, **options):
    """The recipe's plant under these options."""
    return config_class_of(RECIPES / f"{plant}.py")(**options).plant()


@pytest.mark.parametrize(
    ("plant", "options", "message"),
    [
        ("wind_turbine", {"mean_wind": 0.0}, "mean_wind=0.0 m/s must be positive"),
        ("wind_turbine", {"mean_wind": 1e42}, r"mean_wind=1e\+42 m/s must be positive and at most 120"),
        ("wind_turbine", {"mean_wind": math.nan}, "mean_wind=nan must be a finite number"),
        ("wind_turbine", {"turbulence": -0.1}, r"turbulence=-0.1 must lie in \[0, 1\]"),
        ("wind_turbine", {"wind_files": (Path("gone.bts"),)}, "wind_files: gone.bts is no file"),
        ("wind_turbine", {"real": "ROSCO"}, "real='ROSCO' does not exist; choose simulation or rosco"),
        ("flapping_wing", {"mean_wind": 1e42}, r"mean_wind=1e\+42 m/s must lie within ±120"),
        ("flapping_wing", {"wind_deviation": -1.0}, r"wind_deviation=-1.0 m/s must lie in \[0, 120\]"),
        ("flapping_wing", {"peak": "sharp"}, "peak='sharp' does not exist; choose unit or printed"),
        ("cryogenic_tank", {"wall": "thin"}, "wall='thin' does not exist; choose explicit or exponential"),
        ("pendulum", {"guess": 1e308}, r"guess=1e\+308 of the pendulum must be positive and at most 1000"),
        ("pendulum", {"judged_on": "paper"}, "judged_on='paper' does not exist; choose real or plant"),
        ("pendulum", {"horizon": 1e308}, r"horizon=1e\+308 s of plant 'pendulum' is inf steps dt=0.05 s"),
        *[(plant, {"dt": 0.0}, "dt=0.0 s") for plant in ("wind_turbine", "flapping_wing", "cryogenic_tank")],
        *[
            (plant, {"horizon": value}, f"horizon=.* of plant '{plant}' is .* steps .*at most 1e")
            for plant in ("wind_turbine", "flapping_wing", "cryogenic_tank")
            for value in (1e308, 1e15)
        ],
    ],
)
def test_options_out_of_range_are_refused(plant, options, message):
    with pytest.raises(ValueError, match=message):
        made(plant, **options)


def test_wind_that_no_turbine_has_met_is_refused(tmp_path):
    file = tmp_path / "storm.hh"
    file.write_text(HEADER + "".join(LINE.format(time=0.5 * k, speed=1e42 if k == 7 else 11.0) for k in range(1300)))
    with pytest.raises(
        ValueError, match=r"wind_files: .*storm.hh: wind speed at t = 3.5 s is 1e\+42 m/s; it must not exceed 200 m/s"
    ):
        made("wind_turbine", wind_files=(file,))


@pytest.mark.parametrize("plant", ["pendulum", "wind_turbine"])
def test_a_device_that_is_not_there_is_refused_before_the_real_system_is_made(plant, tmp_path):
    """Gymnasium's pendulum is made before the run; so is ROSCO's turbine, where its toolbox is installed."""
    pytest.importorskip("gymnasium" if plant == "pendulum" else "rosco")
    module = recipe(plant)
    real = {} if plant == "pendulum" else {"real": "rosco", "policy": "scheduled"}
    with pytest.raises(ValueError, match="device='nowhere' cannot be used on this machine .* use cpu"):
        module.main(module.Config(device="nowhere", log_dir=tmp_path / "run", compiled=False, **real))
    assert not (tmp_path / "run").exists()


def of_command_line(plant, *words):
    return from_command_line(config_class_of(RECIPES / f"{plant}.py"), words)


PLANTS = {
    "wind_turbine": ("--start", "random"),
    "flapping_wing": ("--start", "random"),
    "cryogenic_tank": ("--start", "random", "--command", "drop", "--end-weight", "0"),
}


@pytest.mark.parametrize("plant", PLANTS)
def test_the_paper_is_one_option(plant):
    """Its policy, observations, cost and numbers of gradients; the other defaults are apart from them."""
    made, paper = load_recipe(RECIPES / f"{plant}.py"), of_command_line(plant, "--paper")
    assert paper.twinning == made.PAPER != of_command_line(plant, "--start", "random").twinning == made.CONVERGED
    usual = of_command_line(plant).twinning
    quiet = dataclasses.replace(made.CONVERGED.exploration, spread=0.02)
    assert usual == dataclasses.replace(made.CONVERGED, exploration=quiet) != made.CONVERGED
    spelled = of_command_line(plant, "--policy", "paper", "--observe", "paper", *PLANTS[plant])
    assert dataclasses.replace(spelled, paper=True, observe=(), twinning=made.PAPER) == paper
    assert paper.plant().observations == spelled.plant().observations and paper.plant().cost == spelled.plant().cost
    default = of_command_line(plant).plant()
    assert (default.observations, default.actions) != (paper.plant().observations, paper.plant().actions)


@pytest.mark.parametrize("plant", PLANTS)
def test_options_that_are_given_hold_with_the_paper_too(plant):
    found = of_command_line(
        plant, "--paper", "--policy", "mlp", "--closure", "mlp", "--twinning.planner.iterations", "7"
    )
    assert found.policy == "mlp" and found.twinning.planner.iterations == 7
    assert found.twinning.assimilation == load_recipe(RECIPES / f"{plant}.py").NEURAL.assimilation
    assert found.plant().observations == of_command_line(plant, "--paper").plant().observations


def test_a_plant_without_a_paper_has_no_words_of_it():
    pendulum = config_class_of(RECIPES / "pendulum.py")
    assert from_command_line(pendulum, ["--policy", "plant", "--closure", "plant"]) == from_command_line(pendulum, [])


@pytest.mark.parametrize(
    ("words", "spread", "starts"),
    [
        ([], 0.02, 32),
        (["--start", "random"], 0.2, 32),
        (["--paper"], 0.2, 0),
        (["--starts", "random", "--episodes", "0"], 0.02, 32),  # what cannot be carried out
    ],
)
def test_the_help_shows_the_defaults_that_hold(words, spread, starts, capsys):
    config = config_class_of(RECIPES / "wind_turbine.py")
    with pytest.raises(SystemExit) as ended:
        from_command_line(config, [*words, "--help"])
    printed = capsys.readouterr()
    assert ended.value.code == 0 and not printed.err
    said = " ".join(printed.out.replace("│", " ").split())
    for option, value in (("exploration.spread FLOAT", spread), ("planner.starts INT", starts)):
        described = said.split(f"--twinning.{option}")[1].split(" --")[0]
        assert f"(default: {value})" in described
