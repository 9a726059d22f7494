"""What a program says and sets before it imports PyTorch, which takes seconds."""

import os
import sys


def begin_loading() -> None:
    """Say at once what the program is doing, and let threads of PyTorch that have nothing to do wait without a core.

    By default they wait actively: beside other programs, a training with two threads took three times as long as with
    this. The environment variable OMP_WAIT_POLICY, where it is set, decides.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    print("loading PyTorch and TorchRL", file=sys.stderr, flush=True)
