"""What step 5 asks of a planner, and its parameters."""

from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from torch import nn

from rt_torchrl.optimisers.descent import Descended, DescentConfig
from rt_torchrl.options import check_options, require_widths
from rt_torchrl.trajectories.trajectory import Scenario


@runtime_checkable
class Planner(Protocol):
    """Improves π_mb on the twin.

    See ``docs/planner.md`` for how to write one.
    """

    policy: nn.Module
    """π_mb, updated in place."""

    def plan(self, episodes: Scenario) -> Descended:
        """Improve the policy on these virtual episodes; the algorithm then judges it on others.

        Returns:
            Mean J_a on ``episodes`` before and after, the first gradient's norm, and the iterations made.

        Raises:
            DivergenceError: if the twin diverges under the policy as it is.
        """

    def refuse(self) -> None:
        """The plan was not better on other episodes: the policy has the weights back that it had before."""

    def restart(self) -> None:
        """Forget what belongs to the weights that the policy had, because they have jumped: it became a clone."""

    def state_dict(self) -> dict[str, Any]:
        """All that the next plan depends on, the policy's weights apart: tensors in plain containers."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state_dict` of a planner of the same configuration."""


@dataclass(frozen=True, kw_only=True)
class ShortHorizonConfig:
    """Parameters of the planning over short windows.

    Args:
        window: control intervals of a window; 0 plans over whole episodes instead, as in the paper.
        discount: γ per control interval.
        mixing: λ, how much the critic's targets trust the rest of the window over the critic itself.
        critic_iterations: gradients of the critic for each window.
        critic_hidden: widths of the critic's hidden layers.
        target_rate: share by which the target critic moves towards the critic after each window.
        policy_rate: learning rate of the policy (Adam).
        critic_rate: learning rate of the critic (Adam).
    """

    window: int = 0
    discount: float = 0.98
    mixing: float = 0.95
    critic_iterations: int = 8
    critic_hidden: tuple[int, ...] = (64, 64)
    target_rate: float = 0.2
    policy_rate: float = 5e-3
    critic_rate: float = 2e-3

    def __post_init__(self) -> None:
        check_options(self)
        require_widths("critic_hidden", self.critic_hidden)
        for argument, least in (("window", 0), ("critic_iterations", 1)):
            if getattr(self, argument) < least:
                raise ValueError(f"{argument}={getattr(self, argument)} of the short horizon must be at least {least}.")
        if not 0.0 <= self.discount < 1.0:
            raise ValueError(f"discount={self.discount} of the short horizon must lie in [0, 1).")
        for argument in ("mixing", "target_rate"):
            if not 0.0 < getattr(self, argument) <= 1.0:
                raise ValueError(f"{argument}={getattr(self, argument)} of the short horizon must lie in (0, 1].")
        for argument in ("policy_rate", "critic_rate"):
            if not getattr(self, argument) > 0.0:
                raise ValueError(f"{argument}={getattr(self, argument)} of the short horizon must be positive.")


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """Parameters of step 5.

    Args:
        iterations: n_mb, gradients per episode; sweeps through whole virtual episodes with a short horizon.
        realisations: N_z of this step; None for that of the others. One virtual episode costs about as much as twenty,
            and where the initial states differ much, a plan made on one of them says little of the others.
        experience: number of latest real episodes whose exogenous inputs steps 5 and 6 draw from; 1 as in the paper.
        descent: how the policy's weights descend J_a.
        short_horizon: planning over short windows, where the gradients of whole episodes say nothing.
    """

    iterations: int = 10
    realisations: int | None = None
    experience: int = 100
    descent: DescentConfig = field(default_factory=DescentConfig)
    short_horizon: ShortHorizonConfig = field(default_factory=ShortHorizonConfig)

    def __post_init__(self) -> None:
        check_options(self)
        if self.iterations < 0:
            raise ValueError(f"iterations={self.iterations} of the planning (n_mb) must not be negative.")
        if self.realisations is not None and self.realisations < 1:
            raise ValueError(f"realisations={self.realisations} of the planning (N_z) must be at least 1.")
        if self.experience < 1:
            raise ValueError(f"experience={self.experience} of the planning must be at least 1 episode.")
