"""The tables that a benchmark prints."""

from collections.abc import Mapping, Sequence

from benchmarking.timing import Cell

HEADER = (
    f"{'steps':>7} {'batch':>6} {'thr':>3} {'':<9}{'contender':<15} "
    f"{'wall':>9} {'CPU':>9} {'us/step':>9} {'first':>8}  gap"
)


def time_table(cells: Sequence[Cell]) -> str:
    """A table of all cells for each case: median wall and CPU time [s], wall time per step, first evaluation, gap."""
    lines = []
    for case in dict.fromkeys(cell.size.case for cell in cells):
        lines += ["", case.name, HEADER]
        lines += [_row(cell) for cell in cells if cell.size.case == case]
    return "\n".join(lines[1:])


def _row(cell: Cell) -> str:
    size = cell.size
    where = f"{size.steps:>7} {size.realisations:>6} {size.threads:>3} {cell.quantity:<9}{cell.contender:<15}"
    if cell.left_out:
        return f"{where}  left out: {cell.left_out}"
    per_step = 1e6 * cell.wall / size.steps
    return f"{where} {cell.wall:9.4f} {cell.cpu:9.4f} {per_step:9.3g} {cell.first:8.2f}  {cell.gap:.0e}"


def start_table(starts: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Compilation without and with caches [s], and the peak memory of a gradient [MiB], each in a fresh process."""
    lines = [f"{'fresh process':<47} {'cold':>7} {'cached':>7} {'peak':>9}"]
    for case, contenders in starts.items():
        for name, found in contenders.items():
            memory = "" if "peak_mib" not in found else (
                f"{found['peak_mib']:7.1f} MiB at {found['steps']} x {found['realisations']}"
            )  # fmt: skip
            lines.append(f"{case + ': ' + name:<47} {found['cold']:5.1f} s {found['warm']:5.1f} s {memory}")
    return "\n".join(lines)


def training_table(trainings: Mapping[str, Sequence[float]]) -> str:
    """Seconds of each step of the algorithm in an episode of a short training."""
    from rt_torchrl.figures.style import STEPS  # here, because --help need not wait for Matplotlib

    short = [step.replace("_", " ") for step in STEPS]
    lines = [f"{'s per episode, steps 1 to 6':<31} " + " ".join(f"{step:>18}" for step in short)]
    lines += [f"{name:<31} " + " ".join(f"{value:18.3f}" for value in row) for name, row in trainings.items()]
    return "\n".join(lines)


def update_table(updates: Mapping[str, Mapping[str, float]]) -> str:
    """CPU milliseconds of an iteration of critic and policy, traced and as TorchRL makes it."""
    ways = list(dict.fromkeys(way for found in updates.values() for way in found))
    lines = [f"{'CPU ms per iteration, step 2':<31} " + " ".join(f"{way:>10}" for way in ways)]
    lines += [f"{plant:<31} " + " ".join(f"{found[way]:10.3f}" for way in ways) for plant, found in updates.items()]
    return "\n".join(lines)
