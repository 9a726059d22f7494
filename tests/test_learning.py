"""Step 2 on trial: an update that is worse on the twin is taken back, if updates are judged."""

import pytest
import torch
from test_first_controller import twinning

GAINS = {"ruined": -0.6, "better": 0.9}


def updated(wanted, **options):
    """An algorithm after an episode in which step 2 sets the gains of the model-free policy; the imitation has 0.4."""
    found = twinning(**options)
    critic = found.learner.update

    def update():
        report = critic()
        found.policies["model_free"].gain.data.fill_(GAINS[wanted])
        return report

    found.learner.update = update
    return found, found.episode()


def test_a_worse_update_is_taken_back_and_its_moments_are_forgotten():
    found, report = updated("ruined", judged_updates=True)
    gain = found.policies["model_free"].gain.detach()
    torch.testing.assert_close(gain, torch.tensor([[0.4, 0.3]], dtype=torch.float64), rtol=1e-2, atol=1e-2)
    assert report["update_accepted"] == 0.0 and "update refused: J_a of model_free would be" in report["reason"]
    assert not found.learner.actor_optimiser.state and report["weight_change"] < 1e-2


def test_a_better_update_stays():
    found, report = updated("better", judged_updates=True)
    assert report["update_accepted"] == 1.0 and "reason" not in report
    assert found.policies["model_free"].gain.detach().unique().tolist() == [GAINS["better"]]


@pytest.mark.parametrize("options", [{}, {"judged_updates": True, "arm": "model_free"}])
def test_every_update_stays_where_none_is_judged(options):
    found, report = updated("ruined", **options)
    assert "update_accepted" not in report
    assert found.policies["model_free"].gain.detach().unique().tolist() == [GAINS["ruined"]]
