"""An environment around a real system."""

from typing import Any

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from rt_torchrl.options import OTHER_UNITS
from rt_torchrl.plants.plant import Plant


class AroundSystem(EnvBase):
    """An environment around the system ``env``, whose attributes it has where it has none of that name.

    Where the system operates without resets, each window of operation counts as an episode.
    """

    env: EnvBase

    def __getattr__(self, name: str) -> Any:
        """An attribute of the system, such as ``plant``, where the environment around it has none of that name."""
        try:
            return super().__getattr__(name)
        except AttributeError:
            if name.startswith("_") or name == "env":
                raise
            return getattr(self.env, name)

    def go_on(self) -> TensorDictBase:
        """Begin the next window of operation without a reset, if the system can.

        Returns:
            What a reset returns.
        """
        found: TensorDictBase = self.env.go_on()
        self._count_window()
        return self._gone_on(found)

    def begin_window(self) -> None:
        """Count a window of operation, which a system around this one has begun."""
        if isinstance(self.env, AroundSystem):
            self.env.begin_window()
        self._count_window()

    def close(self, **kwargs: Any) -> None:
        """Close the system too, such as its connection or its window."""
        self.env.close(**kwargs)
        super().close(**kwargs)

    def _set_seed(self, seed: int | None) -> None:
        self.env.set_seed(seed)

    def _count_window(self) -> None:
        """Count a window; by default nothing is counted."""

    def _gone_on(self, found: TensorDictBase) -> TensorDictBase:
        """What a window begins with, made of what the system begins it with; by default that itself."""
        return found


def innermost(env: EnvBase) -> EnvBase:
    """The system within everything that stands around it."""
    return innermost(env.env) if isinstance(env, AroundSystem) else env


def require_interval(env: EnvBase, interval: float) -> None:
    """Refuse a control interval that is not that of a simulation.

    Args:
        env: the system; of a machine nothing is known.
        interval: control interval [s].

    Raises:
        ValueError: if the simulated plant has another one.
    """
    plant = getattr(innermost(env), "plant", None)
    if isinstance(plant, Plant) and not abs(interval - plant.dt) <= 1e-9 * plant.dt:
        raise ValueError(
            f"interval={interval} s must be the control interval of plant {plant.name!r}, {plant.dt:g} s; check its "
            f"unit: {OTHER_UNITS['s']}."
        )
