"""Fixtures that more than one file uses, and the table of the campaign of faults."""

import os
import signal
from pathlib import Path

import fault_counts
import jaxtyping
import pytest
import torch

if "PYTEST_XDIST_WORKER" in os.environ:
    # The workers share the cores, and so do the processes that they start.
    torch.set_num_threads(1)
    os.environ["OMP_NUM_THREADS"] = "1"
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell ignores Ctrl-C for what it starts in the background; the tests that press it would wait for ever.
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def unchecked():
    """Switch the run-time checks of annotations off, for values that they would refuse before the library does."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def pytest_addoption(parser):
    parser.addoption("--faults-table", type=Path, help="file for the table of counts of the campaign of faults")


def pytest_terminal_summary(terminalreporter, config):
    if not fault_counts.COUNTS or "not faults" in config.getoption("markexpr"):
        return
    terminalreporter.section("faults")
    terminalreporter.write_line(fault_counts.table())
    path = config.getoption("--faults-table")
    if path is not None:
        fault_counts.write(path)
