"""Reinforcement twinning of the cryogenic tank (paper, sections 5.3 and 6.4)."""

import dataclasses
from typing import Any, Literal

import rt_torchrl as rt

rt.begin_loading(__name__)

from rt_torchrl.envs.cryogenic_tank.controllers import OnOffValve, PIValve
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank, PressureCost
from rt_torchrl.envs.cryogenic_tank.unknown import unknown
from rt_torchrl.options import Text

# Knots every 300 s and a kernel of 600 s: the peaks of the load are 675 s wide.
LOAD = rt.ExogenousConfig(knots=1440)
LBFGS = rt.DescentConfig(optimiser="lbfgs", rate=1.0)
PAPER_T3 = dataclasses.replace(
    rt.PAPER,
    realisations=1,
    learner=dataclasses.replace(rt.PAPER.learner, critic_iterations=1000, discount=0.998),
    exogenous=LOAD,
    assimilation=dataclasses.replace(rt.PAPER.assimilation, iterations=30),
    planner=dataclasses.replace(rt.PAPER.planner, iterations=5, descent=LBFGS),
    referee=rt.RefereeConfig(rule="decision_tree", patience=4, clone_patience=20),
)
"""Configuration of the training with ``--preset paper``: Table 1 of the paper, row T3."""
DEFAULT = rt.TwinningConfig(
    realisations=1,
    records=1,
    # The pressure moves over days: the noise lasts a period of the load, returns span 17 h and the discount 42 h.
    exploration=rt.ExplorationConfig(correlation_time=5400.0),
    learner=rt.LearnerConfig(
        critic_iterations=100,  # beside a twin they end where the paper's 1000 end
        actor_iterations=100,
        discount=0.9998,
        return_steps=2000,
        reward_scale=1e-3,
        actor_rate=5e-4,
    ),
    exogenous=LOAD,
    planner=rt.PlannerConfig(
        iterations=12,
        descent=dataclasses.replace(LBFGS, tolerance=1e-6),
        # Twelve hours of duty cycles, each held for half an hour; a plan is made every hour.
        receding_horizon=rt.PredictiveConfig(horizon=43_200.0, hold=1800.0, period=3600.0),
    ),
    referee=rt.RefereeConfig(patience=4, clone_patience=20),
)
"""Configuration of the training by default, whose plans converge."""
NEURAL = dataclasses.replace(
    DEFAULT,
    # Segments last two hours. Without the prior the perceptron takes the first steps, which the constants should take.
    assimilation=rt.AssimilationConfig(iterations=15, segment=240, prior=30.0),
    hypotheses=rt.HypothesesConfig(which=("none",)),
)
"""Configuration of the training with ``--preset neural``."""

VALVES = {"on-off": OnOffValve, "PI": PIValve}
"""Classical controllers that the policies are compared with."""


@rt.configuration
class Config(rt.RunConfig):
    """Train twin and controllers on the cryogenic tank.

    Args:
        policy: paper (a cubic of the pressure error with 3 weights; an affine law of other observations) or mlp.
        observe: what the policies observe, by names of sets and of measurements: paper or errors (of the pressure),
            clock (this and the time of the episode), phase (this and the phase of the orbit), measured (all states),
            measured+load (all of these and the heat load), or names such as heat_load; by default paper.
        command: action of the policies: duty (the share of time in which the valve is open), or drop (the pressure drop
            of a valve that is held half open, as in the paper).
        vented_weight: weight in J_a of the vented mass [s/kg].
        end_weight: weight in J_a of the squared pressure error at the end of an episode, as the time [s] for which that
            error would cost as much, by default 12 h; 0 is the paper's J_a, whose optimum stops venting 12 h before the
            end.
        horizon: length of an episode T_o [s].
        fluid: pure fluid in the tank: Hydrogen, ParaHydrogen, Nitrogen, Oxygen or Methane.
        unknown: what the real system has beside its twin, one or more of bias_5, bias_15, bias_minus_15, drift_10,
            drift_25 (of the pressure sensor), valve_lag and all; docs/unknown_systems.md describes them.
    """

    policy: Literal["paper", "mlp"] = "paper"
    hidden: tuple[int, ...] = (16, 16)
    start: Text = "controller"
    observe: tuple[str, ...] = ()
    command: Literal["duty", "drop"] = "duty"
    vented_weight: float = 5000.0
    end_weight: float = 43.2e3
    closure: Literal["paper", "mlp"] = "paper"
    horizon: float = 4.32e5
    fluid: str = "Hydrogen"
    unknown: tuple[str, ...] = ()
    unseen: int = 100
    twinning: rt.TwinningConfig = DEFAULT

    def __post_init__(self):
        super().__post_init__()
        planned = self.start == "mpc" or self.twinning.planner.method == "receding_horizon"
        if planned and self.command == "drop":
            raise ValueError("command='drop' goes with no predictive control, whose plans it leads astray; use duty.")

    def presets(self) -> dict[rt.Preset, dict[str, Any]]:
        return super().presets() | {
            "default": {"twinning": DEFAULT},
            "paper": {"start": "random", "command": "drop", "end_weight": 0.0, "twinning": PAPER_T3},
            "neural": {"closure": "mlp", "twinning": NEURAL},
        }

    def plant(self) -> rt.Plant:
        return unknown(self.tank(), self.unknown)

    def believed(self) -> CryogenicTank | None:
        """The physics of a twin that does not know what the real tank has beside them."""
        return self.tank() if self.unknown else None

    def tank(self) -> CryogenicTank:
        """The tank as its twin knows it."""
        return CryogenicTank(
            horizon=self.horizon,
            fluid=self.fluid,
            cost=PressureCost(vented=self.vented_weight, end=self.end_weight),
            command=self.command,
            observe=self.observe,
        )

    def plant_figures(self, snapshot):
        from rt_torchrl.envs.cryogenic_tank import figures  # here, because an episode need not wait for Matplotlib

        return figures.figures_of(snapshot)


def main(config: Config, **parts: Any) -> None:
    """Train; ``parts`` are further arguments of :class:`Run`, such as ``learner``."""

    rt.Run(config, config.plant(), baselines=VALVES, first=PIValve, **parts).train()


if __name__ == "__main__":
    rt.main_of(Config, main)
