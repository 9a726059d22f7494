"""A result that a study computes once and keeps."""

import inspect
import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.study.json_file import read_json


@dataclass(frozen=True)
class Yardstick:
    """A yardstick that is computed once and kept, with the arguments that it was computed with.

    Args:
        path: JSON file to keep the result in.
        compute: computes the result; the arguments of a ``partial`` are kept.
    """

    path: Path
    compute: Callable[[], dict[str, Any]]

    def __str__(self) -> str:
        return f"the yardstick in {self.path}"

    def done(self) -> bool:
        """Whether a whole result with these arguments is kept."""
        return self._kept() is not None

    def _kept(self) -> dict[str, Any] | None:
        """The kept result; one of earlier versions, without arguments, counts as one with these."""
        kept = read_json(self.path)
        return kept if kept is not None and kept.get("arguments", self.arguments()) == self.arguments() else None

    def arguments(self) -> dict[str, Any]:
        """The arguments of the computation as JSON gives them back, without the folder of the recipe."""
        if not isinstance(self.compute, partial):
            return {}
        given = inspect.signature(self.compute.func).bind_partial(*self.compute.args, **self.compute.keywords)
        return json.loads(json.dumps(given.arguments, default=lambda value: getattr(value, "stem", None) or str(value)))

    def run(self) -> dict[str, Any]:
        """The kept result, or a new one where none with these arguments is kept or the file is damaged."""
        if (kept := self._kept()) is not None:
            return kept
        if self.path.exists():
            why = "damaged" if read_json(self.path) is None else "of other arguments"
            warnings.warn(f"{self.path} is {why}; what it held is computed again.", stacklevel=2)
        found = self.compute() | {"arguments": self.arguments()}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        content = json.dumps(found, indent=2) + "\n"
        write_atomically(self.path, content.encode())
        return json.loads(content)
