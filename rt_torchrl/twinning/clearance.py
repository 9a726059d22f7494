"""The clearance of policies: which one may act, by what the twin predicts of the plant's limits."""

import copy
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.envs import EnvBase

from rt_torchrl.steps.config import ROLES, Role
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.steps.report import findings
from rt_torchrl.systems.operating_limits import OperatingLimits, require_layer
from rt_torchrl.systems.operating_limits_config import OperatingLimitsConfig
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory


class Cleared(NamedTuple):
    """The policy that may act, the role whose weights it has, and the report of the check."""

    policy: nn.Module
    role: Role
    report: TensorDict


class Clearance:
    """Lets a policy act only if the twin predicts that it keeps the limits.

    The live policy is asked first, then the idle one, then the weights that were cleared last. Before the first real
    episode there are no virtual episodes, and the live policy acts unchecked, behind the safety layer.

    Args:
        env: the real system, which needs a safety layer if there are limits.
        policies: both policies by role.
        virtual: virtual episodes.
        config: the limits.

    Raises:
        ValueError: if the plant has no such limits, see :class:`OperatingLimits`, or the real system no safety layer.
    """

    def __init__(
        self, env: EnvBase, policies: Mapping[Role, nn.Module], virtual: VirtualEpisodes, config: OperatingLimitsConfig
    ):
        if config:
            require_layer(env)
        self.policies, self.virtual, self.config = policies, virtual, config
        self.limits = OperatingLimits(virtual.twin.plant, config)
        self._last: tuple[Role, dict[str, Tensor]] | None = None

    @torch.no_grad()
    def choose(self, live: Role, count: int) -> Cleared:
        """The policy that may act.

        Args:
            live: role that the referee wants to act.
            count: number of virtual episodes of the check.

        Returns:
            The policy. The report holds ``predicted_violations``, its share of control intervals beyond a limit, and a
            reason for each policy that is refused.

        Raises:
            ValueError: if no policy may act.
        """
        if not self.config or not self.virtual.processes:
            return Cleared(self.policies[live], live, findings())
        episodes, reasons = self.virtual.draw(count), list[str]()
        for role in (live, *(other for other in ROLES if other != live)):
            share = self.predicted(self.policies[role], episodes)
            if share <= self.config.tolerated:
                self._last = role, copy.deepcopy(self.policies[role].state_dict())
                return Cleared(self.policies[role], role, findings(*reasons, predicted_violations=share))
            reasons.append(f"{role} may not act: it would leave the limits in {100.0 * share:.3g} % of the intervals")
        if self._last is None:
            raise ValueError(
                f"no policy may act. {'; '.join(reasons)}; limits.tolerated={self.config.tolerated}. Widen the limits "
                "or raise that share, or begin with something that keeps the limits, such as --start controller."
            )
        role, weights = self._last
        policy = copy.deepcopy(self.policies[role])
        policy.load_state_dict(weights)
        return Cleared(policy, role, findings(*reasons, predicted_violations=self.predicted(policy, episodes)))

    def predicted(self, policy: nn.Module, episodes: Scenario) -> float:
        """The share of control intervals of virtual episodes beyond any limit; 1 if the twin diverges."""
        try:
            flown = self.virtual.twin.control(policy, *episodes)
        except DivergenceError:
            return 1.0
        broken = self.limits.broken(flown)
        return torch.stack(list(broken.values())).any(0).double().mean().item()

    def counted(self, flown: Trajectory) -> TensorDict:
        """Numbers of control intervals of a real episode beyond each kind of limits; nothing without limits."""
        if not self.config:
            return findings()
        broken = self.limits.broken(flown)
        return findings(**{f"violations/{kind}": found.sum().double() for kind, found in broken.items()})

    def state_dict(self) -> dict[str, Any]:
        """The role and weights that were cleared last."""
        return {"last": None if self._last is None else {"role": self._last[0], "weights": self._last[1]}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        last = state["last"]
        self._last = None if last is None else (last["role"], last["weights"])
