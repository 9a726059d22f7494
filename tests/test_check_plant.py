"""Every kind of violation of a plant's contract is found, in plants broken on purpose, and told with its remedy."""

import re

import fresh_process
import pytest
import torch
from broken_plants import BROKEN, TRACED, partly_detached
from linear_quadratic import LinearQuadratic

from rt_torchrl import PlantContractError, check_plant


def violations(plant, **options):
    """Violations that the check finds; jaxtyping checks methods during a test, and cannot be traced."""
    with pytest.raises(PlantContractError) as raised:
        check_plant(plant, traced=False, **options)
    return raised.value.violations


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_plant_is_found(kind):
    broken, message = BROKEN[kind]
    found = violations(broken(horizon=20.0 if "diverged" in message else 5.0))
    assert any(re.match(message, text) for text in found), found


def test_every_violation_is_told_at_once():
    class Broken(LinearQuadratic):
        running_cost = partly_detached

        def observe(self, t, state, exogenous):
            return state.detach()

        def terminal_cost(self, state):
            return -1.0 + super().terminal_cost(state)

    found = violations(Broken())
    assert {text.split(":")[0] for text in found} == {"observe", "terminal_cost", "running_cost"}
    with pytest.raises(
        PlantContractError, match=rf"'linear_quadratic' breaks its contract in {len(found)} ways:\n  1. "
    ):
        check_plant(Broken(), traced=False)


def test_a_sound_plant_is_told_what_was_checked():
    found = check_plant(LinearQuadratic(dt=0.1), steps=10, traced=False)
    assert found.plant == "linear_quadratic" and "one graph" not in found.checks
    assert re.fullmatch(
        r"plant 'linear_quadratic' fulfils its contract: signals, draws, .*gradients.*, on 4 flights of 10 intervals "
        r"of 0.1 s",
        str(found),
    )


def test_a_plant_without_chance_is_sound():
    """Every episode of this plant has the same start and no disturbance."""

    class Steady(LinearQuadratic):
        def draw_initial_state(self, batch, generator):
            return torch.ones(batch, 2, dtype=torch.float64)

        def draw_exogenous(self, batch, generator):
            return torch.zeros(batch, self.n_steps, 1, dtype=torch.float64)

    check_plant(Steady(), steps=10, traced=False)


def test_the_check_leaves_no_trace():
    """The check changes neither the plant's weights nor torch's global random numbers."""
    plant = LinearQuadratic()
    before, numbers = plant.closure.matrix.clone(), torch.random.get_rng_state()
    check_plant(plant, traced=False)
    assert torch.equal(plant.closure.matrix, before)
    assert torch.equal(torch.random.get_rng_state(), numbers)


TRACE = """
import sys
sys.path.insert(0, "tests")
from broken_plants import TRACED, Configured, Sorting
from rt_torchrl import check_plant

print(check_plant(Sorting(), steps=5))
print(check_plant(Configured(), steps=5))

for kind in TRACED:
    try:
        check_plant(kind(), steps=5)
    except ValueError as error:
        print(kind.__name__, *error.violations, sep=chr(9))
"""


def test_what_is_not_one_graph_is_found():
    """The check runs in a process of its own, because the run-time checks of this one cannot be traced."""
    done = fresh_process.run(TRACE)
    found = {name: violations for name, *violations in (line.split("\t") for line in done.stdout.splitlines())}
    for kind, message in TRACED.items():
        assert any(re.match(message, text) for text in found[kind.__name__]), (found, done.stderr[-2000:])
    # A plant that only the engine native cannot take fulfils its contract; the report names the line of its code.
    report, configured = (line for line in done.stdout.splitlines() if line.startswith("plant"))
    assert re.search(r"fulfils its contract.*'autograd' takes the place of 'native'.*sort.*broken_plants\.py", report)
    assert re.search(
        r"'autograd' takes the place .*running_cost .*reads the global CONFIG, a dict.*a buffer", configured
    )


class Cornered(LinearQuadratic):
    """A plant whose episodes begin in corners of its laws, where torch has a slope between those of both sides."""

    def draw_initial_state(self, batch, generator):
        return torch.zeros_like(super().draw_initial_state(batch, generator))

    def vector_field(self, t, state, action, exogenous, closure):
        friction = 0.1 * state[..., 1:].abs() + 0.3 * state[..., 1:].clamp(min=0.0)
        return super().vector_field(t, state, action, exogenous, closure) - torch.cat([0.0 * friction, friction], -1)


def test_a_corner_is_no_wrong_derivative():
    check_plant(Cornered())
