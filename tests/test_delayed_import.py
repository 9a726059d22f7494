"""A delayed package is run by its first use, and not by those who only import its name."""

import importlib
import sys
from importlib.util import find_spec

import pytest

from rt_torchrl.runs.delayed_import import delay_import


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of a counter and a submodule; the counter says how often the package has been run."""
    folder = tmp_path / "delayed_package"
    folder.mkdir()
    counter = tmp_path / "runs"
    (folder / "__init__.py").write_text(
        f"open({str(counter)!r}, 'a').write('x')\nimport delayed_package\nvalue = 3\nfrom . import part\n"
    )
    (folder / "part.py").write_text("from delayed_package import value\nabove = value + 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield lambda: len(counter.read_text()) if counter.exists() else 0
    for name in [name for name in sys.modules if name.partition(".")[0] == "delayed_package"]:
        del sys.modules[name]


def test_an_import_and_a_look_at_it_do_not_run_it(package):
    delay_import("delayed_package")
    import delayed_package

    assert find_spec("delayed_package") is delayed_package.__spec__
    assert delayed_package.__file__.endswith("__init__.py")
    assert package() == 0


def test_the_first_use_runs_it_once(package):
    delay_import("delayed_package")
    import delayed_package

    assert (delayed_package.value, delayed_package.part.above) == (3, 4)
    assert sys.modules["delayed_package"] is delayed_package is importlib.import_module("delayed_package")
    assert package() == 1
    with pytest.raises(AttributeError, match="nothing"):
        delayed_package.nothing  # noqa: B018


@pytest.mark.parametrize("line", ["from delayed_package import value", "import delayed_package.part as value"])
def test_imports_from_it_run_it_first(package, line):
    delay_import("delayed_package")
    assert package() == 0
    found = {}
    exec(line, found)
    assert getattr(found["value"], "above", 4) == 4
    assert package() == 1


def test_a_package_that_is_there_or_is_not_installed_stays_so(package):
    import delayed_package

    delay_import("delayed_package")
    assert sys.modules["delayed_package"] is delayed_package
    assert package() == 1
    delay_import("no_such_package")
    assert "no_such_package" not in sys.modules


def test_a_broken_package_says_so_at_each_use(tmp_path, monkeypatch):
    (tmp_path / "broken_package").mkdir()
    (tmp_path / "broken_package" / "__init__.py").write_text("raise ImportError('of another platform')")
    monkeypatch.syspath_prepend(tmp_path)
    delay_import("broken_package")
    import broken_package

    with pytest.raises(ImportError, match="of another platform"):
        broken_package.value  # noqa: B018
    with pytest.raises(ImportError, match="of another platform"):
        importlib.import_module("broken_package")
