"""The code and the commands of the README are right."""

import re
from pathlib import Path

import fresh_process
import pytest
from tensordict import TensorDict

ROOT = Path(__file__).resolve().parent.parent
TUTORIAL = (ROOT / "docs" / "own_plant.md").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_its_code_runs(monkeypatch):
    from rt_torchrl import ReinforcementTwinning

    # The steps are tested elsewhere and take minutes here; what is tested is that the snippet builds them.
    monkeypatch.setattr(
        ReinforcementTwinning,
        "episode",
        lambda self: self.module["interact"](TensorDict({"number": 0}).set_non_tensor("live", self.referee.live)),
    )
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    scope = {}
    exec(code, scope)
    assert scope["report"]["real_cost"] > 0


def test_its_files_exist():
    for path in re.findall(r"\]\(((?!http|#)[^)]+)\)", README) + re.findall(r"uv run (recipes/\S+\.py)", README):
        assert (ROOT / path).exists(), path


@pytest.mark.slow
def test_the_tutorial_runs_as_it_is_printed(tmp_path):
    """In a process of its own, as a user runs it: the check of the plant traces, which this process could not."""
    code = "\n".join(re.findall(r"```python\n(.*?)```", TUTORIAL, re.DOTALL))
    lines = [line for line in code.splitlines() if line.strip() and not line.strip().startswith("#")]
    assert len(lines) < 65
    done = fresh_process.run(code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    upper, lower = map(float, re.findall(r"outlet': ([\d.e-]+)", done.stdout)[:2])
    # The inflow is measured without noise: to rounding.
    assert upper == pytest.approx(5e-5, rel=1e-9) and lower == pytest.approx(4e-5, rel=1e-9)


def test_the_tutorial_says_what_the_check_says():
    from rt_torchrl import PlantContractError

    code = re.findall(r"```python\n(.*?)```", TUTORIAL, re.DOTALL)
    scope = {"__name__": "tutorial"}
    exec(code[0], scope)
    with pytest.raises(PlantContractError, match="is too long for the eigenvalue"):
        scope["check_plant"](scope["TwoTanks"](dt=600.0, horizon=1200.0), traced=False)
