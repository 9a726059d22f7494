"""What the README shows is true."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_its_code_runs(monkeypatch):
    from rt_torchrl import ReinforcementTwinning

    # The steps are tested elsewhere and take minutes here; what is tested is that the snippet builds them.
    monkeypatch.setattr(ReinforcementTwinning, "episode", lambda self: self.interact())
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    scope = {}
    exec(code, scope)
    assert scope["report"]["real_cost"] > 0


def test_its_files_exist():
    for path in re.findall(r"\]\(((?!http|#)[^)]+)\)", README) + re.findall(r"uv run (recipes/\S+\.py)", README):
        assert (ROOT / path).exists(), path
