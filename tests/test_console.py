"""The command rt-torchrl: what it lists, what it runs, and the wheel that gives it."""

import os
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest
from test_packaging import MISSING, ROOT, wheel  # noqa: F401  (a fixture)

from rt_torchrl.runs import console

RECIPES = {path.stem for path in (ROOT / "recipes").glob("*.py")}


def test_it_lists_every_recipe_with_its_purpose(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    console.main([])
    bare = capsys.readouterr().out
    console.main(["--help"])
    assert capsys.readouterr().out == bare and max(map(len, bare.splitlines())) <= 80
    listed = {line.split()[0] for line in bare.splitlines() if line.startswith("  ") and line[2] != " "}
    assert listed == RECIPES | {"FILE.py"} and "Finished runs side by side" in bare


def test_the_list_waits_for_no_library():
    program = "import sys; from rt_torchrl.runs.console import main; main([]); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "False"


def test_an_unknown_recipe_is_refused_with_the_nearest():
    with pytest.raises(SystemExit, match="no recipe 'wind_turbin'; did you mean wind_turbine"):
        console.main(["wind_turbin"])
    with pytest.raises(SystemExit, match=r"mine\.py does not exist"):
        console.main(["mine.py"])


def test_it_runs_a_file_as_a_script(tmp_path, monkeypatch, capsys):
    (tmp_path / "beside.py").write_text("WORD = 'found'\n")
    own = tmp_path / "own.py"
    own.write_text("import sys\nfrom beside import WORD\nif __name__ == '__main__':\n    print(WORD, sys.argv[1:])\n")
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "argv", list(sys.argv))
    console.main([str(own), "--quick"])
    assert capsys.readouterr().out == "found ['--quick']\n"


def test_names_may_have_hyphens():
    assert console.recipe("wind-turbine") == ROOT / "recipes" / "wind_turbine.py"


def test_the_wheel_holds_the_recipes_and_the_command(wheel):  # noqa: F811
    archive = zipfile.ZipFile(wheel)
    names = archive.namelist()
    held = {Path(name).stem for name in names if name.startswith("rt_torchrl/recipes/") and name.count("/") == 2}
    assert held == RECIPES and "rt_torchrl/recipes/benchmarking/case.py" in names
    (entry_points,) = [name for name in names if name.endswith("entry_points.txt")]
    assert "rt-torchrl = rt_torchrl.runs.console:main" in archive.read(entry_points).decode()


@pytest.mark.nightly
@pytest.mark.skipif(bool(MISSING), reason="building a wheel needs build and hatchling")
def test_an_installed_wheel_trains_reports_and_is_read_back(wheel, tmp_path):  # noqa: F811
    """In an environment that shares only the dependencies with this one, from a folder outside the checkout."""
    home = tmp_path / "env"
    venv.create(home, with_pip=False)
    (site,) = home.glob("lib/python*/site-packages")
    zipfile.ZipFile(wheel).extractall(site)
    shared = next(path for path in sys.path if path.endswith("site-packages"))
    (site / "shared.pth").write_text(shared + "\n")
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    program = "from rt_torchrl.runs.console import main; main()"

    def run(*words):
        command = [str(home / "bin" / "python"), "-c", program, *words]
        return subprocess.run(command, cwd=tmp_path, env=clean, capture_output=True, text=True)

    trained = run("wind_turbine", "--quick", "--threads", "1", "--no-figures", "--log-dir", "run")
    assert trained.returncode == 0 and "recipes/" not in trained.stdout, trained.stderr
    exported = run("export", "run", "--formats", "c")
    assert exported.returncode == 0 and list((tmp_path / "run" / "exported").glob("*.c")), exported.stderr
