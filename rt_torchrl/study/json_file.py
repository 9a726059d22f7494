"""Results that the study keeps as JSON."""

import json
from pathlib import Path
from typing import Any


def read_json(path: Path) -> dict[str, Any] | None:
    """Content of a JSON file that holds one object; None where the file is missing, empty or damaged.

    A process that is killed while it writes leaves a file that is empty or ends early, which is never whole JSON.
    """
    try:
        found = json.loads(path.read_text())
    except (FileNotFoundError, json.JSONDecodeError, UnicodeDecodeError):
        return None
    return found if isinstance(found, dict) else None
