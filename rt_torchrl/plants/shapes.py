"""Shapes of the signals of a plant, named once: any leading batch dimensions, and the signals in the last one."""

from jaxtyping import Bool, Float
from torch import Tensor

Time = Float[Tensor, "*#batch"]
"""Time t [s], one for all realisations or one for each."""
State = Float[Tensor, "*batch n_s"]
"""States s."""
Hidden = Float[Tensor, "*batch n_x"]
"""Hidden states x of an extension, which no sensor reads."""
Action = Float[Tensor, "*batch n_a"]
"""Commands or applied actions a."""
Input = Float[Tensor, "*#batch n_z"]
"""Exogenous inputs z."""
Observation = Float[Tensor, "*batch n_o"]
"""Observations e of the policies."""
Cost = Float[Tensor, "*batch"]
"""A cost, or its rate, per realisation."""
Ended = Bool[Tensor, "*batch"]
"""Whether the episode of a realisation ends."""
States = Float[Tensor, "batch samples n_s"]
"""States of whole episodes, one sample more than intervals."""
Actions = Float[Tensor, "batch n n_a"]
"""Applied actions of whole episodes."""
Inputs = Float[Tensor, "batch n n_z"]
"""Exogenous inputs of whole episodes."""
Draws = Float[Tensor, "{batch} {n_steps}"]
"""Samples of one signal, as a method with the arguments ``batch`` and ``n_steps`` draws them."""
Scalar = Float[Tensor, "*batch"]
"""A quantity per realisation."""
Memory = Float[Tensor, "*batch n_m"]
"""The memory of a controller."""
Starts = Float[Tensor, "batch n_s"]
"""States at the starts of episodes or segments."""
Start = float | Float[Tensor, " batch"]
"""Times of these starts on the plant's clock [s], one for all or one for each."""
Costs = Float[Tensor, " batch"]
"""A cost per episode."""
