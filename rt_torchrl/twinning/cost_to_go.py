"""The cost-to-go that the model-free half learns, for model predictive control."""

from torch import nn

from rt_torchrl.control.predictive_control import PredictiveControl


def share_critic(learner: object, policy: nn.Module) -> None:
    """Give model predictive control the cost-to-go of the model-free half, if it is to price the end of its windows.

    Args:
        learner: learner of step 2.
        policy: policy π_mb.

    Raises:
        ValueError: if the learner has no method ``cost_to_go``.
    """
    if isinstance(policy, PredictiveControl) and policy.terminal == "critic":
        cost_to_go = getattr(learner, "cost_to_go", None)
        if cost_to_go is None:
            raise ValueError(
                f"terminal='critic' of the receding horizon needs a learner with a method cost_to_go(observation); "
                f"{type(learner).__name__} has none. Use terminal plant."
            )
        policy.value = cost_to_go
