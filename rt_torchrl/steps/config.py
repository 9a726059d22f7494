"""Hyper-parameters of the six steps."""

from dataclasses import field
from typing import Annotated, Literal

from pydantic import Field

from rt_torchrl.control.predictive_control import PredictiveConfig
from rt_torchrl.optimisers.descent import DescentConfig
from rt_torchrl.options import AtLeastOne, Count, NotNegative, Positive, configuration
from rt_torchrl.systems.config import OperatingLimitsConfig
from rt_torchrl.systems.exploration import ExplorationConfig

Role = Literal["model_free", "model_based"]
Pilot = Role | Literal["first"]
Arm = Literal["twinning", "model_free", "model_based"]
ROLES: tuple[Role, Role] = ("model_based", "model_free")
EXPERIENCE = 100
"""Number of latest real episodes whose exogenous inputs steps 5 and 6 draw from; the paper has 1."""


@configuration
class LearnerConfig:
    """Parameters of step 2.

    Args:
        algorithm: model-free method, a loss of TorchRL: ``ddpg``; ``relaxed_ddpg``, DDPG as the paper prints it, whose
            critic is its own target and takes the share τ of every step, without importance weights and a limit of the
            policy's gradient; ``td3``, which takes the lower value of two critics, delays the policy and smooths the
            targets; or one that also prices the entropy of a policy with noise: ``sac``, ``crossq`` (normalised layers
            instead of targets) or ``redq`` (more critics).
        critic_iterations: number n_Q of critic iterations per episode.
        actor_iterations: number n_A of DDPG's policy iterations per episode; TD3 makes one for every second critic
            iteration instead, the others one for each.
        batch_size: number n_b of transitions in a batch; it is at most the number n_t of control intervals.
        discount: discount factor γ per control interval.
        return_steps: number of control intervals whose rewards a target sums before it bootstraps; 1 as in the paper.
            Where a control interval is short beside the dynamics, one action matters less than the critic's error; a
            sum over more intervals mends that.
        reward_scale: factor on the rewards that the critic learns from. A value is about the mean reward over 1 − γ;
            scaled to the order of ten, a perceptron reaches it within an episode. Reports are unscaled.
        target_rate: rate τ at which the targets follow, or share of its step that a relaxed critic takes.
        actor_rate: learning rate of the policy (Adam).
    """

    algorithm: Literal["ddpg", "relaxed_ddpg", "td3", "sac", "crossq", "redq"] = "ddpg"
    critic_iterations: Count = 200
    actor_iterations: Count = 200
    batch_size: AtLeastOne = 128
    discount: Annotated[float, Field(ge=0, lt=1)] = 0.98
    return_steps: AtLeastOne = 1
    reward_scale: Positive = 1.0
    target_rate: Positive = 0.01
    actor_rate: Positive = 2e-3


@configuration
class ExogenousConfig:
    """Parameters of step 3.

    Args:
        knots: number of points of the decimated record in the regression, whose cost grows with its square.
        kernel_width: standard deviation of the Gaussian kernel κ, in knot spacings; wider changes of the input count as
            large scale.
        penalty: penalty C of the support vector regression, for a record scaled to unit standard deviation.
        tube: half-width ε of the regression's tube, in standard deviations of the record.
        large_scale: large scale of the disturbances that steps 5 and 6 draw: met for those of the real episodes, as in
            the paper; mixed for new ones that differ from the mean of those met as these do, see :func:`mixed`; or
            drawn for those of the plant. A policy with hundreds of weights fits itself to a few winds that were met,
            and few winds do not hold the rare ones that cost most. Set points, on which no equation depends, are always
            as the plant draws them.
    """

    knots: Annotated[int, Field(ge=8)] = 300
    kernel_width: Positive = 2.0
    penalty: Positive = 10.0
    tube: Positive = 0.05
    large_scale: Literal["met", "mixed", "drawn"] = "met"


@configuration
class PlannerConfig:
    """Parameters of step 5.

    Args:
        method: method of the model-based policy. ``multi_start`` descends the cost of whole virtual episodes from
            several starts and compares the plans (:class:`MultiStart`). ``single_start`` does what the paper does: it
            descends from the present weights, in virtual episodes that begin as the last real one did under draws of
            its input, and keeps every plan. ``receding_horizon`` is model predictive control, which has no weights of
            its own and plans while it acts.
        iterations: number n_mb of gradients per episode.
        realisations: number N_z of virtual episodes that a plan is made on; None takes ``realisations`` of the
            algorithm. Twenty virtual episodes take about as long as one, and where the initial states differ much, a
            plan made on one of them says little about the others.
        starts: number of random policies, the best of which is a start of ``multi_start``; 0 plans from the present
            weights alone.
        descent: parameters of the policy's descent.
        receding_horizon: parameters of model predictive control.
    """

    method: Literal["multi_start", "single_start", "receding_horizon"] = "multi_start"
    iterations: Count = 40
    realisations: AtLeastOne | None = 20
    starts: Count = 32
    descent: DescentConfig = field(default_factory=lambda: DescentConfig(optimiser="lbfgs", rate=1.0))
    receding_horizon: PredictiveConfig = field(default_factory=PredictiveConfig)


@configuration
class RefereeConfig:
    """Parameters of step 6.

    Args:
        rule: rule of the referee: ``decision_tree``, as in the paper, or ``expected_cost``, which lets the policy act
            that is expected to cost less on the real system. With this rule plans, updates of a live π_mf and clones
            are judged by what they are expected to cost there, too (:class:`~rt_torchrl.steps.belief.Belief`); with the
            paper's, plans and distilled clones are judged by the twin alone, and updates by nothing.
        patience: number P_π of episodes in a row that a reason to swap must outlast, in the decision tree.
        clone_patience: number P_w of episodes in a row that the idle policy may stall; if it stalls longer, it becomes
            a clone.
    """

    rule: Literal["decision_tree", "expected_cost"] = "expected_cost"
    patience: Count = 2
    clone_patience: Count = 3


ESTIMABLE = ("levenberg_marquardt", "record")
"""Method of the fit, and inputs of its replays, with which first states can be unknowns beside the weights."""


@configuration
class AssimilationConfig:
    """Parameters of step 4.

    Args:
        iterations: number n_G of gradients per episode.
        stop_below: J_p below which the descent ends; with 0 it never ends early.
        inputs: exogenous input of the replay: ``realisations`` for N_z samples of the exogenous process, as in the
            paper, or ``record`` for the measured input. With realisations a twin does not fit chance in the input, but
            it also does not find weights that move the states less than that chance does.
        method: method of the fit: ``levenberg_marquardt``, which solves the normal equations from forward
            sensitivities, for closures of some ten weights; ``lbfgs`` with a line search; or ``adam`` with a rate of
            0.1, as the paper's.
        prior: factor ρ of a cost ½ρ‖w − w⁰‖² beside J_p, in the unit of J_p, on the weights w of the closure's
            perceptrons (:class:`BoundedPerceptron`); 0 leaves it out. Weights of which the records say nothing then
            keep their initial values, and so the law keeps its initial form where no record has been.
        segment: number of control intervals after which the replay starts again from the measured state (multiple
            shooting); 0 replays whole records, as in the paper. Over short segments the states are nearly linear in the
            weights, so a closure with many weights fits the record in a few steps. J_p is then the mean over the
            segments. None lets the data choose: whole records, unless the twin is unstable and leaves
            them; then the longest segments that it follows as well as shorter ones.
        initial: first state of a replay: ``measured`` for the first reading of the sensors, as in the paper, or
            else ``estimated``, with which the components that J_p compares are unknowns beside the weights. A plant
            that forgets slowly carries the error of the first reading through the whole record, and the weights would
            make up for it. The choice ``estimated`` needs ``levenberg_marquardt`` and the inputs of the ``record``.
            None lets the data choose: ``estimated`` from the first fit on that leaves noise of the sensors, see
            :func:`rt_torchrl.fit.sensors.noise_levels`, of more than 1 % of the scatter of what they read. Whichever
            method fits, flights on the twin then have this noise.
    """

    iterations: Count = 30
    stop_below: NotNegative = 0.0
    inputs: Literal["realisations", "record"] = "record"
    method: Literal["adam", "lbfgs", "levenberg_marquardt"] = "levenberg_marquardt"
    prior: NotNegative = 0.0
    segment: Count | None = None
    initial: Literal["measured", "estimated"] | None = None

    def __post_init__(self) -> None:
        if self.initial == "estimated" and (self.method, self.inputs) != ESTIMABLE:
            raise ValueError(f"initial='estimated' needs method, inputs = {ESTIMABLE}, not {self.method, self.inputs}.")


@configuration
class HypothesesConfig:
    """Parameters of the hypotheses.

    Args:
        which: ``automatic`` for what the plant suspects (:meth:`Plant.suspects`), ``none`` for the twin alone, or names
            of suspects, also of those that are taken only by name (:meth:`Plant.further_suspects`).
        call: size of the paired difference log J − log Ĵ of a real episode, beyond what noise of the sensors explains,
            above which the hypotheses are fitted; until then the twin is trained alone, which takes less time. 0 fits
            them always.

    Raises:
        ValueError: if an argument is out of its range.
    """

    which: Annotated[tuple[str, ...], Field(min_length=1)] = ("automatic",)
    call: NotNegative = 0.05

    def __post_init__(self) -> None:
        if len(self.which) > 1 and {"automatic", "none"} & set(self.which):
            raise ValueError(f"which={self.which} of the hypotheses must be automatic, none, or names of suspects.")


@configuration
class TwinningConfig:
    """Hyper-parameters of the algorithm, by step.

    The defaults suit a plant with some ten unknown coefficients whose inputs are measured: step 4 solves least squares
    over the last eight records, and step 5 descends by L-BFGS on twenty virtual episodes. The paper's are ``PAPER``.

    Args:
        arm: part of the algorithm that runs: ``twinning`` for all six steps, ``model_free`` for steps 1 and 2 alone, or
            else ``model_based`` for steps 1, 3, 4 and 5 alone.
        realisations: number N_z of samples of the exogenous process, for each record in step 4 and in all in step 5.
        records: number n_S of latest real episodes that step 4 trains the twin on, few of a system that wears; steps 5
            and 6 draw exogenous inputs from at least as many.
        virtual_episodes: number N of virtual episodes on which step 5 judges a plan and step 6 compares the policies;
            twenty times as many where episodes may end early.
        limits: limits of the real system, which a safety layer holds for every policy, and which the twin must predict
            to be kept before a policy may act.
        exploration: parameters of step 1.
        learner: parameters of step 2.
        exogenous: parameters of step 3.
        assimilation: parameters of step 4.
        hypotheses: parameters of the hypotheses about what the real system has beside its twin.
        planner: parameters of step 5.
        referee: parameters of step 6.
    """

    arm: Arm = "twinning"
    realisations: AtLeastOne = 5
    records: AtLeastOne = 8
    virtual_episodes: AtLeastOne = 20
    limits: OperatingLimitsConfig = field(default_factory=OperatingLimitsConfig)
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    exogenous: ExogenousConfig = field(default_factory=ExogenousConfig)
    assimilation: AssimilationConfig = field(default_factory=AssimilationConfig)
    hypotheses: HypothesesConfig = field(default_factory=HypothesesConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    referee: RefereeConfig = field(default_factory=RefereeConfig)


PAPER = TwinningConfig(
    records=1,
    learner=LearnerConfig(algorithm="relaxed_ddpg", critic_iterations=500, actor_iterations=1000, target_rate=0.02),
    assimilation=AssimilationConfig(iterations=15, method="adam", inputs="realisations", segment=0),
    planner=PlannerConfig(method="single_start", iterations=10, realisations=None, descent=DescentConfig()),
    referee=RefereeConfig(rule="decision_tree"),
    hypotheses=HypothesesConfig(which=("none",)),
)
"""The paper's algorithm, with the numbers of its first test case (Table 1, row T1). Of what the paper does not print,
τ is 0.02, with which the critic stays finite, and optimisers, their rates and the exploration are the library's."""
