"""The study's report: Markdown, and the same as one HTML page that holds its figures."""

import base64
import re
from pathlib import Path

import markdown

STYLE = """
body { font-family: sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; line-height: 1.45; color: #222 }
table { border-collapse: collapse; margin: 1rem 0; font-size: 0.9rem }
th, td { border-bottom: 1px solid #ddd; padding: 0.3rem 0.7rem; text-align: right }
th:first-child, td:first-child { text-align: left }
img { max-width: 100% }
"""


def table(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def figure(path: Path, folder: Path, text: str) -> str:
    """A figure with its caption, linked relative to the report's folder."""
    return f"![{text}]({path.relative_to(folder)})\n\n*{text}*"


def write(folder: Path, title: str, sections: list[str]) -> tuple[Path, Path]:
    """``README.md`` and ``report.html`` of these sections.

    Args:
        folder: of the report; figures are linked relative to it.
        title: heading of the page.
        sections: Markdown.

    Returns:
        Both paths.
    """
    text = f"# {title}\n\n" + "\n\n".join(sections) + "\n"
    source, page = folder / "README.md", folder / "report.html"
    source.write_text(text)
    body = markdown.markdown(text, extensions=["tables", "fenced_code"])
    body = re.sub(r'src="([^"]+\.png)"', lambda found: f'src="{embedded(folder / found[1])}"', body)
    head = f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
    page.write_text(f"{head}</head><body>{body}</body></html>\n")
    return source, page


def embedded(path: Path) -> str:
    """A PNG as a data address."""
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
