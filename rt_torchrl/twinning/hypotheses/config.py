"""Parameters of the hypotheses about what the real system has beside its twin."""

from dataclasses import dataclass
from typing import Literal

from rt_torchrl.options import check_options


@dataclass(frozen=True, kw_only=True)
class HypothesesConfig:
    r"""Parameters of the hypotheses, whose weights are :math:`w_h \propto p_h (\epsilon_{min}/\epsilon_h)^\kappa`.

    Here ε is the J_p with which a hypothesis replays the records.

    Args:
        which: ``automatic`` for what the plant suspects (:meth:`Plant.suspects`), or ``none`` for the twin alone.
        call: size of the paired difference log J − log Ĵ of a real episode, beyond what exploration explains, above
            which the hypotheses are fitted; until then the twin is trained alone, which takes less time. 0 fits them
            always.
        names: names of the suspects that are taken, also of those that are taken only by name
            (:meth:`Plant.further_suspects`); all of the others if there are none.
        prior: prior weight p_h of every addition, as a share of that of the twin alone. A small one asks for evidence
            before anything is added.
        sharpness: exponent κ, which stands for the number of independent samples in the records.
        least: weight, as a share of the greatest one, below which a hypothesis is left out of the plan.
        segment: number of control intervals after which a replay begins again with what was read; by default a sixtieth
            of an episode.
        risk: share ρ of the worst hypothesis in the cost that is planned on, (1 − ρ) Σ w_h J_h + ρ max J_h.

    Raises:
        ValueError: if an argument is out of its range.
    """

    which: Literal["none", "automatic"] = "automatic"
    call: float = 0.05
    names: tuple[str, ...] = ()
    prior: float = 0.01
    sharpness: float = 6.0
    least: float = 0.1
    segment: int | None = None
    risk: float = 0.0

    def __post_init__(self) -> None:
        check_options(self)
        for argument in ("prior", "sharpness"):
            if not getattr(self, argument) > 0.0:
                raise ValueError(f"{argument}={getattr(self, argument)} of the hypotheses must be positive.")
        for argument in ("least", "risk"):
            if not 0.0 <= getattr(self, argument) < 1.0:
                raise ValueError(f"{argument}={getattr(self, argument)} of the hypotheses must lie in [0, 1).")
        if not self.call >= 0.0:
            raise ValueError(f"call={self.call} of the hypotheses must not be negative.")
        if self.segment is not None and self.segment < 2:
            raise ValueError(f"segment={self.segment} of the hypotheses must be at least 2 control intervals.")
        if self.names and self.which == "none":
            raise ValueError(f"names={self.names} of the hypotheses need which='automatic'; it is 'none'.")
