"""An environment around a real system."""

from typing import Any

from torchrl.envs import EnvBase


class AroundSystem(EnvBase):
    """An environment around the system ``env``, whose attributes it has where it has none of that name."""

    env: EnvBase

    def __getattr__(self, name: str) -> Any:
        """An attribute of the system, such as ``plant``, where the environment around it has none of that name."""
        try:
            return super().__getattr__(name)
        except AttributeError:
            if name.startswith("_") or name == "env":
                raise
            return getattr(self.env, name)
