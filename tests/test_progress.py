"""The bar of a training says what is under way, and moves while it is."""

import time

import torch
from test_algorithm import STEPS, twinning

from rt_torchrl.runs import progress
from rt_torchrl.runs.progress import Progress
from rt_torchrl.trajectories.engines.parallel import watched_compilation


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
