"""Closing what stands around a machine closes the machine, once."""

from linear_quadratic import LinearQuadratic

from rt_torchrl import PlantEnv, Reading, RealSystem, SafetyConfig, SafetyLayer


class Machine(PlantEnv):
    closed = 0

    def close(self, **kwargs):
        self.closed += 1
        super().close(**kwargs)


def test_a_real_system_behind_a_safety_layer_is_closed():
    plant = LinearQuadratic(horizon=2.0)
    machine = Machine(plant)
    layer = SafetyLayer(machine, SafetyConfig(interval=plant.dt), fallback=(0.0,))
    entries = {"state": Reading(keys=("state",)), "exogenous": Reading(keys=("exogenous",))}
    system = RealSystem(layer, plant, **entries, applied=Reading(keys=("applied",)))
    assert machine.closed == 0
    system.close()
    assert machine.closed == 1 and layer.is_closed and system.is_closed
