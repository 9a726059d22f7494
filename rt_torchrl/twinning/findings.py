"""The report of an episode: scalars by name, the policy that acted, the event, and the reasons for refusals."""

import math
from collections.abc import Mapping
from functools import partial

import torch
from tensordict import TensorDict
from torch import Tensor, nn


def findings(*reasons: str, **values: float | Tensor | str) -> TensorDict:
    """A report with scalars in double precision, texts and, if there are reasons, the entry ``reason``.

    Args:
        reasons: reasons for refusals, one sentence each.
        values: the scalars and texts, by name.
    """
    # A report is on the CPU, because it is read there and its numbers come from any device.
    double = partial(torch.as_tensor, dtype=torch.float64, device="cpu")
    report = TensorDict({key: double(x).detach() for key, x in values.items() if not isinstance(x, str)})
    for key, text in values.items():
        if isinstance(text, str):
            report.set_non_tensor(key, text)
    return report.set_non_tensor("reason", "; ".join(reasons)) if reasons else report


def plain(report: TensorDict) -> dict[str, float | str]:
    """The entries of a report as numbers and texts."""
    entries = {key: report[key] for key in report.keys()}  # noqa: SIM118  (a TensorDict iterates over its batch)
    return {key: value if isinstance(value, str) else float(value) for key, value in entries.items()}


def as_findings(entries: Mapping[str, float | str]) -> TensorDict:
    """The report of which :func:`plain` has made these entries."""
    return findings(**entries)


def merged(report: TensorDict, other: TensorDict) -> TensorDict:
    """The report with the entries of ``other`` added; the reasons of both stay."""
    reasons = [part["reason"] for part in (report, other) if "reason" in part]
    report.update(other)
    return report.set_non_tensor("reason", "; ".join(reasons)) if reasons else report


def in_words(cost: float, digits: int = 3) -> str:
    """A cost as people read it; one that is infinite or not a number is said in words.

    Args:
        cost: the cost, infinite where the twin diverges, and not a number where nobody has computed it.
        digits: number of significant digits.
    """
    if math.isnan(cost):
        return "not computed"
    return f"{cost:.{digits}g}" if math.isfinite(cost) else "diverges"


class EpisodeReport(TensorDict):
    """The report of a whole episode; printed, it is a few lines about costs, the live policy and the event."""

    def __repr__(self) -> str:
        real = f"J_a {self['real_cost']:.4g}" if "real_cost" in self else "no real episode"
        lines = [f"real episode: {real}" + (f", flown by {self['live']}" if "live" in self else "")]
        if "J_p" in self:
            after, before = (in_words(float(self[key]), 4) for key in ("J_p", "J_p_before"))
            believed = f" with {self['believed']!r}" if "believed" in self else ""
            lines.append(f"twin{believed}: J_p {after}, {before} before assimilation")
        judged = [key for key in ("J_a_model_based", "J_a_model_free") if key in self]
        costs = [f"{key[4:]} {in_words(float(self[key]), 4)}" for key in judged]
        lines += [f"J_a on the twin: {', '.join(costs)}"] if costs else []
        lines += [f"{key}: {self[key]}" for key in ("event", "warning", "reason", "refusal") if key in self]
        return "\n".join(lines)


def weight_vector(module: nn.Module) -> Tensor:
    """All weights of a module in one vector, detached."""
    return torch.cat([weight.detach().flatten() for weight in module.parameters()]).clone()


def weight_change(module: nn.Module, earlier: Tensor) -> Tensor:
    """The relative change ‖w − w_earlier‖/‖w‖ of a module's weights since they were the vector ``earlier``."""
    now = weight_vector(module)
    return (now - earlier).norm() / now.norm()
