"""Every kind of violation of a plant's contract is found, in plants broken on purpose, and told with its remedy."""

import re

import pytest
import torch
from broken_plants import BROKEN, UNTRACEABLE, partly_detached
from linear_quadratic import LinearQuadratic

from rt_torchrl import PlantContractError, check_plant


def violations(plant, **options):
    """Violations that the check finds."""
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
    assert found.plant == "linear_quadratic"
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


@pytest.mark.parametrize("kind", UNTRACEABLE)
def test_what_machine_code_cannot_take_is_told_with_its_line(kind):
    """Such a plant fulfils its contract."""
    found = check_plant(kind(), steps=5)
    assert re.search(UNTRACEABLE[kind], found.untraceable), found.untraceable
    assert "fulfils its contract" in str(found) and "'autograd' takes the place of 'native'" in str(found)


class Cornered(LinearQuadratic):
    """A plant whose episodes begin in corners of its laws, where torch has a slope between those of both sides."""

    def draw_initial_state(self, batch, generator):
        return torch.zeros_like(super().draw_initial_state(batch, generator))

    def vector_field(self, t, state, action, exogenous, closure):
        friction = 0.1 * state[..., 1:].abs() + 0.3 * state[..., 1:].clamp(min=0.0)
        return super().vector_field(t, state, action, exogenous, closure) - torch.cat([0.0 * friction, friction], -1)


def test_a_corner_is_no_wrong_derivative():
    check_plant(Cornered())
