"""The commands and code that README and documentation print, as they stand there."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXTS = {page.name: page.read_text(encoding="utf-8") for page in PAGES}
BLOCK = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def blocks(page: str, language: str) -> list[str]:
    """The code blocks of a page in one language."""
    return [code for kind, code in BLOCK.findall(TEXTS[page]) if kind == language]


def spans(page: str) -> list[str]:
    """The code in the sentences and tables of a page, each in one line."""
    return [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", BLOCK.sub("", TEXTS[page]))]


def commands() -> list[str]:
    """Every command line that begins with ``uv run``, once, without its comment."""
    lines = [line for page in TEXTS for block in blocks(page, "sh") for line in block.splitlines()]
    lines += [span for page in TEXTS for span in spans(page)]
    found = (re.sub(r"\s+#.*", "", line) for line in lines if line.startswith("uv run "))
    return list(dict.fromkeys(found))


def options() -> list[str]:
    """Every group of options that a sentence or a table names on its own, once."""
    return list(dict.fromkeys(span for page in TEXTS for span in spans(page) if span.startswith("--")))


def run_code(page: str, code: str | None = None, **scope: object) -> dict[str, object]:
    """What the Python code of a page, or this code of it, defines."""
    exec(compile(code or "\n".join(blocks(page, "python")), f"docs/{page}", "exec"), scope)
    return scope


def documented(page: str, name: str) -> type:
    """The class of this name from the code on a page of the documentation."""
    (code,) = [code for code in blocks(page, "python") if f"class {name}" in code]
    return run_code(page, code)[name]
