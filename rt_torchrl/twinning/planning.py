"""Step 5: the planner's plan, which stays unless the referee finds it worse."""

import copy
from collections.abc import Callable
from typing import NamedTuple

from tensordict import TensorDict
from torch import Tensor

from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.twinning.findings import findings
from rt_torchrl.twinning.planners import Planner
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes


class Judgement(NamedTuple):
    """How a plan is judged.

    Args:
        incumbent: function that gives the mean J_a of the present policy on virtual episodes.
        worse: function that says whether the first of two mean J_a is worse than the second one.
        require_sound_twin: function that refuses a twin that diverges in these episodes with the weights that have just
            flown, by an error.
    """

    incumbent: Callable[[Scenario], Tensor]
    worse: Callable[[float, float], bool]
    require_sound_twin: Callable[[Scenario], None]


class Planning:
    """Lets the planner plan on some virtual episodes, and judges the plan on others.

    Note: the paper keeps every plan. Here a plan made on N_z winds is compared with the previous policy on N other
    winds, because the best policy for a few winds can lie just beyond a cliff of another wind. State feedback plans
    while it acts, so that there is nothing to compare.

    Args:
        planner: planner of step 5.
        virtual: virtual episodes.
    """

    def __init__(self, planner: Planner, virtual: VirtualEpisodes):
        self.planner, self.virtual = planner, virtual

    def plan(self, planned_on: Scenario, judged_on: Scenario, judgement: Judgement) -> TensorDict:
        """Plan, and go back to the earlier weights if the plan is worse.

        Args:
            planned_on: virtual episodes of the plan.
            judged_on: virtual episodes on which it is judged.
            judgement: how it is judged.

        Raises:
            DivergenceError: if the twin diverges with the weights that have just flown.
        """
        policy = self.planner.policy
        before = copy.deepcopy(policy.state_dict())
        judged = not isinstance(policy, StateFeedback)
        incumbent = judgement.incumbent(judged_on).item() if judged else 0.0
        try:
            found = self.planner.plan(planned_on)
        except DivergenceError as error:
            judgement.require_sound_twin(planned_on)
            policy.load_state_dict(before)
            self.planner.restart()
            return findings(f"no plan: {error}", plan_accepted=0.0)
        accepted = not judged or not judgement.worse(self.virtual.cost(policy, judged_on).item(), incumbent)
        if not accepted:
            policy.load_state_dict(before)
            self.planner.refuse()
        return findings(
            J_a_plan_before=found.start,
            J_a_plan=found.best if accepted else found.start,
            policy_gradient=found.gradient,
            plan_accepted=float(accepted),
        )
