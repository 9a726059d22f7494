"""The closure of the last episode, which the twin gets back if it diverges with the new one."""

import copy
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict
from torch import nn

from rt_torchrl.steps.plan import Planner
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.assimilation import Assimilation
from rt_torchrl.twinning.findings import findings, merged


class EarlierClosure:
    """The closure from before the last assimilation.

    Args:
        twin: twin whose closure is kept.
        model_based: policy that is planned on the twin.
        planner: planner of that policy.
        generator: source of the draws of steps 5 and 6.
        assimilation: step 4, which knows the first closure.
    """

    def __init__(
        self,
        twin: DigitalTwin,
        model_based: nn.Module,
        planner: Planner,
        generator: torch.Generator,
        assimilation: Assimilation,
    ):
        self.twin, self.model_based, self.planner, self.generator = twin, model_based, planner, generator
        self.assimilation = assimilation
        self._closure: dict[str, Any] | None = None

    def remember(self) -> None:
        """Keep the present closure."""
        self._closure = copy.deepcopy(self.twin.closure.state_dict())

    def sound(self, step: Callable[[], TensorDict]) -> TensorDict:
        """Take step 5 or 6; if the twin diverges in it, repeat it with the closure of the last episode, then the first.

        The weights that have just flown did not diverge on the real system. If the twin diverges with them, the closure
        must be wrong. Any other policy may diverge on a sound twin, and loses. Note: the paper keeps every closure.
        Where the sensors' noise is larger than the effect of the closure, even the closure that replays the records
        best may diverge in other flights, and the real system cannot wait. A twin without the dynamics of the real
        system bends every closure that is fitted, but not the one that it began with.

        Where it diverges with the first closure too, the step is left out: the real system goes on.

        An interrupt or another error gives π_mb its weights back: it may have those of a scout, or of half a plan.
        """
        policy = copy.deepcopy(self.model_based.state_dict())
        try:
            return self._sound(step, policy)
        except BaseException:
            self.model_based.load_state_dict(policy)
            raise

    def _sound(self, step: Callable[[], TensorDict], policy: dict[str, Any]) -> TensorDict:
        state = self.generator.get_state()
        try:
            return step()
        except DivergenceError as error:
            found = error
        refused = f"closure refused: {found}"
        for closure in filter(None, (self._closure, self.assimilation.first)):
            self.model_based.load_state_dict(policy)  # state feedback holds the refused closure too
            self.twin.closure.load_state_dict(closure)
            self._closure = None
            self.twin.retreat()
            self.generator.set_state(state)
            self.planner.restart()
            try:
                return merged(step(), findings(refused, closure_refused=1.0))
            except DivergenceError as error:
                found = error
        self.model_based.load_state_dict(policy)
        left_out = findings(refused, f"step left out: {found}", closure_refused=1.0, alarm=1.0)
        return left_out.set_non_tensor("warning", f"the twin diverges under a policy that has flown: {found}")
