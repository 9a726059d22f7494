"""How an engineer judges the episodes of a plant, beside their cost."""

from jaxtyping import Bool, Float
from torch import Tensor


class Merits:
    """Quantities, setpoints and kinds of episodes; a plant overrides those that it has."""

    def merit(
        self,
        states: Float[Tensor, "batch samples n_s"],
        applied: Float[Tensor, "batch n n_a"],
        exogenous: Float[Tensor, "batch n n_z"],
    ) -> dict[str, Float[Tensor, " batch"]]:
        """Physical quantities by which an engineer judges whole episodes, named with their units; by default none."""
        return {}

    def setpoints(
        self,
        states: Float[Tensor, "*batch n n_s"],
        applied: Float[Tensor, "*batch n n_a"],
        exogenous: Float[Tensor, "*batch n n_z"],
    ) -> dict[str, tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"]]]:
        """Quantities to be held, named with their units: value and setpoint in each interval; by default none."""
        return {}

    def categories(self, exogenous: Float[Tensor, "batch n n_z"]) -> dict[str, Bool[Tensor, " batch"]]:
        """Kinds of episodes, by name, for which results are also shown separately; by default none."""
        return {}
