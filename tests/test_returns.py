"""Targets over several control intervals, on an episode small enough to sum by hand."""

import pytest
import torch
from linear_quadratic import LinearQuadratic
from tensordict import TensorDict

from rt_torchrl.twinning.learners import DDPG, LearnerConfig


def episode(n):
    """Observations k, rewards k + 1, truncated at the end."""
    k = torch.arange(n, dtype=torch.float64).unsqueeze(-1)
    done = torch.zeros(n, 1, dtype=torch.bool)
    done[-1] = True
    following = {
        "observation": (k + 1).expand(n, 2),
        "reward": k + 1,
        "done": done,
        "terminated": torch.zeros_like(done),
    }
    return TensorDict({"observation": k.expand(n, 2), "action": k, "next": following, "state": k}, [n])


def learner(return_steps, discount=0.5, **options):
    plant, generator = LinearQuadratic(), torch.Generator().manual_seed(0)
    config = LearnerConfig(return_steps=return_steps, discount=discount, critic_hidden=(8,), **options)
    return DDPG(plant, plant.make_policy(generator), config, generator=generator)


def test_one_step_is_the_transition_itself():
    found = learner(1).transitions(episode(4))
    assert found["next", "reward"].flatten().tolist() == [1.0, 2.0, 3.0, 4.0]
    assert found["next", "observation"][:, 0].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert "state" not in found


def test_rewards_are_summed_over_whole_windows_only():
    found = learner(3).transitions(episode(4))
    # 1 + 2/2 + 3/4 and 2 + 3/2 + 4/4; after the third interval only two remain.
    assert found["next", "reward"].flatten().tolist() == pytest.approx([2.75, 4.5], rel=1e-6)
    assert found["next", "observation"][:, 0].tolist() == [3.0, 4.0]
    assert found["steps_to_next_obs"].flatten().tolist() == [3, 3]


def test_rewards_are_scaled_for_the_critic_and_the_episode_is_left_as_it_is():
    flown = episode(4)
    found = learner(3, reward_scale=0.1).transitions(flown)
    assert found["next", "reward"].flatten().tolist() == pytest.approx([0.275, 0.45], rel=1e-6)
    assert flown["next", "reward"].flatten().tolist() == [1.0, 2.0, 3.0, 4.0]


def test_a_window_longer_than_an_episode_is_refused():
    with pytest.raises(ValueError, match=r"return_steps=1000000 exceeds the \d+ control intervals"):
        learner(1_000_000)


def test_the_target_discounts_by_the_steps_it_has_summed():
    model_free = learner(3)
    found = model_free.transitions(episode(4))
    with torch.no_grad():
        action = model_free.policy(found["next", "observation"])
        bootstrap = model_free.critic(found["next", "observation"], action)  # the target critic starts as its copy
        discount = 0.5**3
        y = found["next", "reward"] + discount * bootstrap
        delta = y - model_free.critic(found["observation"], found["action"])
    # TorchRL keeps γ in single precision.
    torch.testing.assert_close(model_free.td_errors(found), delta.abs().squeeze(-1), rtol=1e-6, atol=1e-7)
