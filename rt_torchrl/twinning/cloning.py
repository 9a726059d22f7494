"""The idle policy becomes a clone of the live one."""

import copy
import functools
from collections.abc import Callable, Mapping
from typing import TypeVar

import torch
from jaxtyping import Float
from tensordict import TensorDict
from torch import Tensor, nn

from rt_torchrl.control.predictive_control import PredictiveControl
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory, control_cost
from rt_torchrl.twinning.architecture import same_architecture
from rt_torchrl.twinning.distillation import Distillation, DistillationConfig
from rt_torchrl.twinning.extreme_starts import astray
from rt_torchrl.twinning.findings import findings, merged
from rt_torchrl.twinning.judgement import Judgement
from rt_torchrl.twinning.referees import Role
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes

Result = TypeVar("Result")

TWICE = 2.0
"""Cost of an imitation from extreme starts over the controller's that is a failure: a small one differs everywhere."""


class Cloning:
    """Copies weights between policies of the same architecture, and distils one into another architecture.

    Args:
        virtual: virtual episodes, on which clones are trained and judged.
        config: parameters of the distillation.
        count: number of virtual episodes that a distillation draws at a time.
    """

    def __init__(self, virtual: VirtualEpisodes, config: DistillationConfig, count: int):
        self.virtual, self.count = virtual, count
        self.distillation = Distillation(virtual.twin, config)

    def clone(
        self,
        live: nn.Module,
        idle: nn.Module,
        *,
        seen: Callable[[], Float[Tensor, "n n_o"]],
        record: Trajectory,
        costs: tuple[float, float],
        judged_on: Scenario,
        judgement: Judgement,
    ) -> TensorDict:
        """Make ``idle`` a clone of ``live``; it keeps its weights if a distilled clone is worse than it is.

        Args:
            live: the policy that is cloned; it is not changed.
            idle: the policy that becomes the clone.
            seen: function that gives observations of the real system; a copy of weights does not call it.
            record: the real episode that ``live`` has just flown, from which a clone of state feedback learns.
            costs: mean J_a of ``live`` and of ``idle`` over the episodes of ``judged_on``.
            judged_on: virtual episodes on which the clone is judged.
            judgement: how the clone and the policy that it replaces are judged.

        Returns:
            A report, which is empty after a copy of weights. After a distillation it holds ``distillation_error`` and
            ``distillation_cost_ratio``; if the clone is refused, the event is ``keep``, and ``reason`` says why. State
            feedback has no weights that could imitate, so that a clone of it is refused.
        """
        if isinstance(idle, StateFeedback):
            reason = f"no clone: {type(idle).__name__} plans its actions and cannot imitate a policy"
            return findings(reason).set_non_tensor("event", "keep")
        if same_architecture(live, idle):
            idle.load_state_dict(live.state_dict())
            return findings()
        before, live_cost = copy.deepcopy(idle.state_dict()), costs[0]
        replaced = judgement.of(idle, costs[1]).expected
        source = record if isinstance(live, StateFeedback) else seen()
        error = self.distillation.imitate(live, idle, seen=source, draw=lambda: self.virtual.draw(self.count))
        clone = judgement.costs(idle, self.virtual, judged_on)
        cost, found = clone.expected, {"distillation_error": error, "distillation_cost_ratio": clone.twin / live_cost}
        if not judgement.worse(cost, replaced):
            return findings(**found)
        idle.load_state_dict(before)
        reason = f"clone refused: its J_a is {cost:.4g}, that of the policy it replaces {replaced:.4g}"
        return findings(reason, **found).set_non_tensor("event", "keep")

    def begin(
        self, teacher: nn.Module | None, policies: Mapping[Role, nn.Module], records: Trajectory, *, on_twin: bool
    ) -> TensorDict:
        """Make the policies imitate a controller; one that would fare worse on the twin than before stays as it was.

        Args:
            teacher: the controller, a policy or :class:`StateFeedback`; None if only the records show its actions.
            policies: the policies by role; state feedback among them is left alone.
            records: real episodes that the controller has flown.
            on_twin: whether policies also learn from virtual episodes and are judged in them.

        Returns:
            ``start_error_`` of each role, the RMS difference of the actions as a share of their ranges, and on the twin
            ``start_cost_ratio_``, J_a of the policy over the controller's.
        """
        pupils = {role: policy for role, policy in policies.items() if not isinstance(policy, StateFeedback)}
        starts = {role: copy.deepcopy(policy) for role, policy in pupils.items()}
        # Every virtual episode of model predictive control takes as long as its solves.
        count = teacher.virtual_episodes if isinstance(teacher, PredictiveControl) else self.count
        judged_on = self.virtual.draw(count) if on_twin else None
        report = findings()
        for role, policy in pupils.items():
            first = next(other for other, start in starts.items() if clones(start, starts[role]))
            if first != role:
                policy.load_state_dict(pupils[first].state_dict())
            elif judged_on is None:
                report.update(findings(**{f"start_error_{role}": self.distillation.of_record(policy, records)}))
            else:
                report = merged(report, self._imitated(teacher, role, policy, records, judged_on))
        return report

    def _imitated(
        self, teacher: nn.Module | None, role: Role, policy: nn.Module, records: Trajectory, judged_on: Scenario
    ) -> TensorDict:
        before, start = copy.deepcopy(policy.state_dict()), self.virtual.price(policy, judged_on).item()
        if teacher is None:
            error = self.distillation.of_record(policy, records)
            wanted = control_cost(self.virtual.twin.plant, records).mean().item()
        else:
            draw = functools.partial(self.virtual.draw, len(judged_on.initial_state))
            error = self.distillation.imitate(teacher, policy, seen=records, draw=draw)
            wanted = self.virtual.price(teacher, judged_on).item()
            if self._astray(teacher, policy, judged_on, wanted):
                policy.load_state_dict(before)
                error = self.distillation.imitate(
                    teacher, policy, seen=records, draw=lambda: self.virtual.with_extremes(draw())
                )
        cost = self.virtual.price(policy, judged_on).item()
        found = {f"start_error_{role}": error, f"start_cost_ratio_{role}": cost / wanted}
        if cost <= start:
            return findings(**found)
        policy.load_state_dict(before)
        return findings(
            f"{role} does not imitate the controller: its J_a would be {cost:.4g}, not {start:.4g}", **found
        )

    def _astray(self, teacher: nn.Module, policy: nn.Module, judged_on: Scenario, wanted: float) -> bool:
        """Whether an imitation fails from extreme starts; flights of model predictive control take too long to ask."""
        if isinstance(teacher, PredictiveControl):
            return False
        own, model = (self.virtual.tail(each, judged_on) for each in (policy, teacher))
        cost = self.virtual.price(policy, judged_on).item()
        return own > TWICE * abs(model) and astray(own, model, cost=cost, usual=wanted)


def of_each_role(policies: Mapping[Role, nn.Module], flown: Callable[[nn.Module], Result]) -> dict[Role, Result]:
    """What ``flown`` returns for each policy; it is called once if the two are clones of each other.

    Args:
        policies: both policies, by role.
        flown: function of a policy's weights alone, such as its costs over given episodes.
    """
    first, second = policies
    found = {first: flown(policies[first])}
    return found | {second: found[first] if clones(*policies.values()) else flown(policies[second])}


def clones(first: nn.Module, second: nn.Module) -> bool:
    """Whether two policies are the same function with the same weights."""
    if not same_architecture(first, second):
        return False
    pairs = zip(first.state_dict().values(), second.state_dict().values(), strict=True)
    return all(torch.equal(one, other) for one, other in pairs)
