"""The report of an episode: scalars by name, the policy that acted, the event, and the reasons for refusals."""

from collections.abc import Mapping
from functools import partial

import torch
from tensordict import TensorDict
from torch import Tensor, nn


def findings(*reasons: str, **values: float | Tensor) -> TensorDict:
    """A report with scalars in double precision and, if there are reasons, the entry ``reason``.

    Args:
        reasons: reasons for refusals, one sentence each.
        values: the scalars, by name.
    """
    # A report is on the CPU, because it is read there and its numbers come from any device.
    double = partial(torch.as_tensor, dtype=torch.float64, device="cpu")
    report = TensorDict({key: double(value).detach() for key, value in values.items()})
    return report.set_non_tensor("reason", "; ".join(reasons)) if reasons else report


def plain(report: TensorDict) -> dict[str, float | str]:
    """The entries of a report as numbers and texts."""
    entries = {key: report[key] for key in report.keys()}  # noqa: SIM118  (a TensorDict iterates over its batch)
    return {key: value if isinstance(value, str) else float(value) for key, value in entries.items()}


def as_findings(entries: Mapping[str, float | str]) -> TensorDict:
    """The report of which :func:`plain` has made these entries."""
    texts = {key: value for key, value in entries.items() if isinstance(value, str)}
    report = findings(**{key: value for key, value in entries.items() if not isinstance(value, str)})
    for key, text in texts.items():
        report.set_non_tensor(key, text)
    return report


def merged(report: TensorDict, other: TensorDict) -> TensorDict:
    """The report with the entries of ``other`` added; the reasons of both stay."""
    reasons = [part["reason"] for part in (report, other) if "reason" in part]
    report.update(other)
    return report.set_non_tensor("reason", "; ".join(reasons)) if reasons else report


class EpisodeReport(TensorDict):
    """The report of a whole episode; printed, it is a few lines about costs, the live policy and the event."""

    def __repr__(self) -> str:
        real = f"J_a {self['real_cost']:.4g}" if "real_cost" in self else "no real episode"
        lines = [f"real episode: {real}" + (f", flown by {self['live']}" if "live" in self else "")]
        if "J_p" in self:
            lines.append(f"twin: J_p {self['J_p']:.4g}, {self['J_p_before']:.4g} before assimilation")
        costs = [f"{key[4:]} {self[key]:.4g}" for key in ("J_a_model_based", "J_a_model_free") if key in self]
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
