"""What a run on a real system refuses, because only a plant in simulation can do it, and the other way round."""

import pytest
from linear_quadratic import LinearQuadratic
from test_real_system import connected, run_on

from rt_torchrl import RealController, RunConfig
from rt_torchrl.runs.run import Run


@pytest.mark.parametrize("options", [{"noise": 0.1}, {"reference": True}])
def test_options_of_a_simulation_are_refused(options, tmp_path):
    with pytest.raises(ValueError, match="real system"):
        run_on(connected(LinearQuadratic(horizon=2.0)), tmp_path, **options)


@pytest.mark.parametrize("simulated", [True, False])
def test_a_real_controller_is_refused_where_policies_are_judged_in_simulation(simulated, tmp_path):
    class Machine(RealController):
        def fly_real(self, count, *, seed):
            raise AssertionError("nothing is flown")

    plant = LinearQuadratic(horizon=2.0)
    env = None if simulated else connected(plant, closure=plant.closure)
    config = RunConfig(log_dir=tmp_path / "run", compiled=False)
    with pytest.raises(ValueError, match=r"baselines \['machine'\] can only be flown on a real system"):
        Run(config, plant, env=env, baselines={"machine": Machine})
    assert not (tmp_path / "run").exists()
