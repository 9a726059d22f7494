"""Whole runs on the oracle plant that take seconds."""

import dataclasses

from linear_quadratic import LinearQuadratic
from seeds_and_numbers import stepped

from rt_torchrl import ExplorationConfig, HypothesesConfig, LearnerConfig, RefereeConfig, Run, RunConfig, TwinningConfig

FULL = TwinningConfig(
    hypotheses=HypothesesConfig(which=("none",)),  # a twin that has hardly learned would call for them
    realisations=2,
    virtual_episodes=2,
    exploration=ExplorationConfig(episodes=2),
    learner=LearnerConfig(critic_iterations=3, actor_iterations=3, batch_size=8),
    # No patience, so that swaps and clones happen within the few episodes of a test.
    referee=RefereeConfig(patience=0, clone_patience=0),
)
IDLE = LearnerConfig(critic_iterations=0, actor_iterations=0, batch_size=8)
"""A learner without iterations, whose tracing takes longer than all else in a short episode."""
SMALL = dataclasses.replace(FULL, learner=IDLE)
"""Options of small runs: all steps, and all but the model-free policy's iterations."""


def stepped_cost(episodes, policy):
    """Mean J_a of a policy without the library's rollout."""
    flown = episodes.plant, episodes.closure, episodes.initial_state, episodes.exogenous
    return stepped(*flown, lambda k, t, s, z: policy(s))[2].mean().item()


def believing(physics):
    """A class of options whose twin believes in some physics."""

    class Believing(RunConfig):
        def believed(self):
            return physics

    return Believing


def small_run(folder, episodes=3, plant=None, *, config=RunConfig, parts=None, **options):
    """A run of a plant under some options; ``parts`` are further arguments of the run."""
    options = {"unseen": 3, "figures": False, "twinning": SMALL} | options
    made = config(episodes=episodes, log_dir=folder, **options)
    return Run(made, plant or LinearQuadratic(horizon=2.0), **parts or {})
