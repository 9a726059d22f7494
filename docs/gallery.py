"""Draw the pictures of the gallery: train each plant, and copy its figures under their names."""

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PICTURES = {
    "wind_turbine": (
        *("flights.png", "states.png", "power_and_speed.png", "power_coefficient.png"),
        *(
            "exogenous.png",
            "policy_contours.png",
            "closure_weights.png",
            "learned_law.png",
            "learning_curves.png",
            "unseen.png",
        ),
    ),
    "flapping_wing": ("flight_path.png", "flight.png", "polars.png", "control_surfaces.png"),
    "cryogenic_tank": ("tank.png",),
}
"""Files of each plant that the gallery shows, by the name of its recipe."""

if __name__ == "__main__":
    for plant, names in PICTURES.items():
        folder = ROOT / "runs" / "gallery" / plant
        shutil.rmtree(folder, ignore_errors=True)
        options = ["--threads", "1", "--log-dir", folder]
        subprocess.run([sys.executable, ROOT / "recipes" / f"{plant}.py", *options], check=True)
        for name in names:
            shutil.copyfile(folder / "figures" / name, ROOT / "docs" / "gallery" / f"{plant}_{name}")
