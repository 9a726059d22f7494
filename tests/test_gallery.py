"""The command that draws the gallery: its pictures are those of the page, and one training gives them."""

import re

import pytest
from test_export_recipe import RECIPES, recipe

PAGE = (RECIPES.parent / "docs" / "gallery.md").read_text(encoding="utf-8")


def test_its_pictures_are_those_of_the_page():
    pictures = {f"{plant}_{name}" for plant, names in recipe("gallery").PICTURES.items() for name in names}
    assert pictures == set(re.findall(r"\(gallery/([\w.]+)\)", PAGE))
    assert all((RECIPES.parent / "docs" / "gallery" / name).is_file() for name in pictures)


def test_an_unknown_plant_is_refused():
    with pytest.raises(ValueError, match="must be some of wind_turbine, flapping_wing, cryogenic_tank"):
        recipe("gallery").Config(plants=("pendulum",))


@pytest.mark.nightly
def test_a_training_gives_the_pictures_of_a_plant(tmp_path):
    gallery = recipe("gallery")
    gallery.main(gallery.Config(plants=("wind_turbine",), quick=True, output=tmp_path / "out", log_dir=tmp_path))
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        f"wind_turbine_{name}" for name in gallery.PICTURES["wind_turbine"]
    }
