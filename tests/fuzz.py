"""A coverage-guided fuzzer of the readers of files, with atheris (on Linux).

``uv run --group test --with atheris tests/fuzz.py log.csv -max_total_time=60`` fuzzes one reader; the options after its
name are those of libFuzzer. The corpus and the files that break a reader lie in the folder ``fuzzing/NAME``.
"""

import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["rt_torchrl"]):
    from malformed_files import GOOD, READERS, outcome

OF_FILES = ("refused", "sound")


def main() -> None:
    names = sys.argv[1:2]
    if not names or names[0] not in READERS:
        raise SystemExit(f"error: give a reader: {', '.join(READERS)}")
    name, folder = names[0], Path("fuzzing") / names[0].replace(" ", "_")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "good").write_bytes(GOOD[name])
    with tempfile.TemporaryDirectory() as scratch:

        def one(file: bytes) -> None:
            found = outcome(name, file, Path(scratch))
            if found not in OF_FILES:
                raise RuntimeError(f"{name}: {found}")

        options = [f"-artifact_prefix={folder}/broken-", "-max_len=20000", "-rss_limit_mb=4096", *sys.argv[2:]]
        atheris.Setup([sys.argv[0], *options, str(folder)], one)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
