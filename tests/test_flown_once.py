"""Nothing is flown twice."""

from small_runs import small_run
from torch.nn.utils import parameters_to_vector


def test_policies_of_equal_weights_are_flown_once(tmp_path, monkeypatch):
    """An unseen episode of a real system may take hours."""
    run, flown = small_run(tmp_path, episodes=1, untrained=0), []
    for name in ("fly", "control_costs"):
        call = getattr(run.unseen, name)
        monkeypatch.setattr(run.unseen, name, lambda policy, call=call: flown.append(policy) or call(policy))
    run.train()
    policies = [*run.initial_policies.values(), *run.algorithm.policies.values()]
    # The model-free policy starts as a clone of the model-based one.
    distinct = {tuple(parameters_to_vector(policy.parameters()).tolist()) for policy in policies}
    assert len(distinct) == 3
    assert sorted(tuple(parameters_to_vector(policy.parameters()).tolist()) for policy in flown) == sorted(distinct)
