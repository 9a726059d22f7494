"""The command ``rt-torchrl``, which runs the recipes, also where the library was installed from a wheel."""

import ast
import difflib
import runpy
import sys
from collections.abc import Sequence
from pathlib import Path

PROGRAM = "rt-torchrl"
PACKAGE = Path(__file__).resolve().parent.parent
HELP = ("-h", "--help")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a recipe under its name with the words that follow, as ``python recipes/NAME.py`` does in a checkout.

    Without a name, or with ``--help``, it lists the recipes at once: nothing of them is imported.

    Args:
        arguments: words of the command line; by default those of this process.

    Raises:
        SystemExit: if there is no such recipe, with the name that is nearest to it.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in HELP:
        print(listing())
        return
    if words[0] == "--version":
        import rt_torchrl

        print(f"rt_torchrl {rt_torchrl.__version__}")
        return
    path = recipe(words[0])
    sys.argv = [f"{PROGRAM} {words[0]}", *words[1:]]
    sys.path.insert(0, str(path.parent))  # as for a script, so that a recipe can import what lies beside it
    runpy.run_path(str(path), run_name="__main__")


def recipes() -> dict[str, Path]:
    """The files of the recipes by name: those of the wheel or, in a checkout, of the folder ``recipes``."""
    folders = (PACKAGE / "recipes", PACKAGE.parent / "recipes")
    folder = next((place for place in folders if place.is_dir()), folders[0])
    return {path.stem: path for path in sorted(folder.glob("*.py"))}


def recipe(name: str) -> Path:
    """The file of a recipe: one of :func:`recipes`, or a file of one's own.

    Args:
        name: name of a recipe, or a path that ends in ``.py``.

    Raises:
        SystemExit: if there is none.
    """
    path = Path(name) if name.endswith(".py") else recipes().get(name.replace("-", "_"))
    if path is None or not path.is_file():
        near = difflib.get_close_matches(name, recipes(), n=1)
        meant = f"did you mean {near[0]}? " if near else ""
        raise SystemExit(f"error: there is no recipe {name!r}; {meant}{PROGRAM} --help lists them all.")
    return path.resolve()


def call_of(name: str) -> str:
    """How a recipe is called here: by the command or, in a checkout, by its file."""
    return f"{PROGRAM} {name}" if (PACKAGE / "recipes").is_dir() else f"recipes/{name}.py"


def listing() -> str:
    """The recipes with what each one is for."""
    return "\n".join(
        [
            f"usage: {PROGRAM} RECIPE [OPTIONS]",
            "",
            *(f"  {name:18}  {purpose(path)}" for name, path in recipes().items()),
            f"  {'FILE.py':18}  A recipe of your own.",
            "",
            f"{PROGRAM} RECIPE --help lists the options of a recipe.",
            f"A first run: {PROGRAM} wind_turbine --quick",
        ]
    )


def purpose(path: Path) -> str:
    """The first sentence of a recipe's docstring."""
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(docstring.split("\n\n")[0].split())
