"""The ruler's table, from finished trainings."""

import json
import subprocess
import sys
from pathlib import Path

RULER = Path(__file__).parent / "ruler.py"


def finished(folder, model_based, model_free, paid):
    folder.mkdir(parents=True)
    unseen = {"J_a_model_based": {"mean": model_based}, "J_a_model_free": {"mean": model_free}}
    metrics = {"summary": {"live": "model_free", "unseen": unseen}, "episodes": [{"real_cost": cost} for cost in paid]}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    (folder / "seconds.json").write_text("12.0")


def test_a_row_has_ranges_and_counts_trainings_whose_dearer_policy_is_live(tmp_path):
    finished(tmp_path / "turbine-pitch" / "0", 1.0, 1.25, [2.0, 3.0])
    finished(tmp_path / "turbine-pitch" / "1", 1.5, 1.5, [4.0, 4.0])
    command = [sys.executable, str(RULER), "--seeds", "2", "--folder", str(tmp_path), "--rows", "turbine, pitch"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "| turbine, pitch | 2 | 1.25 … 1.5 | 1 … 1.5 | 1 | 5 … 8 | 12 |"
