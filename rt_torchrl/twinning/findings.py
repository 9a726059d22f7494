"""The report of an episode: scalars by name, the event, and the reasons for what was refused."""

from functools import partial

import torch
from tensordict import TensorDict
from torch import Tensor, nn


def findings(*reasons: str, **values: float | Tensor) -> TensorDict:
    """Scalars in double precision, with the entry ``reason`` if there are any.

    Args:
        reasons: why something was refused, a sentence each.
        values: the scalars.
    """
    # On the CPU, because a report is read there and its numbers come from anywhere.
    double = partial(torch.as_tensor, dtype=torch.float64, device="cpu")
    report = TensorDict({key: double(value).detach() for key, value in values.items()})
    return report.set_non_tensor("reason", "; ".join(reasons)) if reasons else report


def merged(report: TensorDict, other: TensorDict) -> TensorDict:
    """``report`` with the entries of ``other``; reasons of both stay."""
    reasons = [part["reason"] for part in (report, other) if "reason" in part]
    report.update(other)
    return report.set_non_tensor("reason", "; ".join(reasons)) if reasons else report


def weight_vector(module: nn.Module) -> Tensor:
    """All weights of a module, detached, in one vector."""
    return torch.cat([weight.detach().flatten() for weight in module.parameters()]).clone()
