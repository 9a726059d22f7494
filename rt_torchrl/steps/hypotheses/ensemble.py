"""Several twins side by side: the twin itself, and one for each hypothesis of what the real system has beside it."""

import copy
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.options import quoted
from rt_torchrl.plants.extension import Extension
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Actions, Costs, Inputs, Starts
from rt_torchrl.steps.config import HypothesesConfig
from rt_torchrl.trajectories.rollout import Engine, able
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin

ALONE = "as the twin"
"""Name of the hypothesis that the real system has nothing beside its twin."""


class TwinEnsemble(DigitalTwin):
    r"""A digital twin whose predictions are those of weighted hypotheses.

    .. math:: J(\pi) = \sum_h w_hJ_h(\pi)

    Each hypothesis is a twin of its own, of a plant that extends the ensemble's. Initial states and records are those
    that sensors read; every hypothesis has its hidden states at rest at the start. Replays and sensitivities are those
    of the twin alone.

    Args:
        plant: physics of the twin alone.
        closure: its closure.
        suspects: plants that extend ``plant``, by name.
        closures: closures of these plants, by name.
        engine: see :class:`DigitalTwin`; a hypothesis that the engine cannot roll out has ``autograd``.

    Raises:
        ValueError: if a plant does not extend the twin's plant.
    """

    def __init__(
        self,
        plant: Plant,
        closure: nn.Module,
        suspects: Mapping[str, Plant],
        closures: Mapping[str, nn.Module],
        *,
        engine: Engine = "native",
    ):
        super().__init__(plant, closure, engine=engine)
        for name, suspect in suspects.items():
            if suspect.readings != plant.states or suspect.dt != plant.dt:
                raise ValueError(f"hypothesis {name!r} must extend the twin's plant {plant.name!r}, which it does not.")
        self.twins = {ALONE: DigitalTwin(plant, closure, engine=engine)}
        for name, suspect in suspects.items():
            law, extended = closures[name], suspect
            while extended is not plant and isinstance(extended, Extension):  # what is at rest is so by what was found
                extended.closure = law
                law, extended = extended.of_base(law), extended.base
            self.twins[name] = DigitalTwin(suspect, closures[name], engine=able(engine, suspect))
        self.weights: dict[str, float] = {ALONE: 1.0}
        """Weights of the hypotheses that are planned on; they sum to one."""

    @property
    def likeliest(self) -> str:
        """Name of the hypothesis with the greatest weight."""
        return max(self.weights, key=self.weights.__getitem__)

    @property
    def believed(self) -> DigitalTwin:
        """The twin of the likeliest hypothesis."""
        return self.twins[self.likeliest]

    @property
    def hypothesis(self) -> str | None:
        """Name of the likeliest hypothesis; None if that is the twin alone."""
        return None if self.likeliest == ALONE else self.likeliest

    @property
    def believed_law(self) -> nn.Module:
        """Closure of the ensemble's plant as the likeliest hypothesis has found it."""
        plant, closure = self.believed.plant, self.believed.closure
        while plant is not self.plant and isinstance(plant, Extension):
            closure, plant = plant.of_base(closure), plant.base
        return closure

    def state_dict(self) -> dict[str, Any]:
        """As :meth:`DigitalTwin.state_dict`, and ``hypotheses``: their closures, and the weights of all that count."""
        closures = {name: twin.closure.state_dict() for name, twin in self.twins.items() if name != ALONE}
        return super().state_dict() | {"hypotheses": {"closures": closures, "weights": dict(self.weights)}}

    def load_hypotheses(self, state: Mapping[str, Any]) -> None:
        """Take the closures of the hypotheses and their weights, as ``hypotheses`` of :meth:`state_dict` holds them.

        Raises:
            ValueError: if the hypotheses are others, or a closure does not fit.
        """
        closures, names = state["closures"], [name for name in self.twins if name != ALONE]
        if closures.keys() != set(names):
            raise ValueError(
                f"hypotheses {quoted(closures)} of the state are not those of the twin, {quoted(names)}; plant "
                f"{self.plant.name!r} must suspect what it suspected then."
            )
        for name in names:
            try:
                self.twins[name].closure.load_state_dict(closures[name])
            except RuntimeError as error:
                raise ValueError(f"closure of hypothesis {name!r} does not fit: {error}") from error
        self.weights = dict(state["weights"])

    def retreat(self) -> None:
        """Leave every hypothesis out for this episode: the policy that has just flown diverges under one."""
        self.weights = {ALONE: 1.0}

    def control(
        self, policy: nn.Module, initial_state: Float[Tensor, "batch n_s"], exogenous: Float[Tensor, "batch n n_z"]
    ) -> Trajectory:
        """Virtual episodes under the likeliest hypothesis, as sensors read them; see :meth:`DigitalTwin.control`."""
        twin = self.believed
        flown = twin.control(policy, twin.plant.at_rest(initial_state), exogenous)
        return flown._replace(states=flown.states[..., : len(self.plant.states)])

    def episode_costs(
        self, policy: nn.Module, initial_state: Starts, exogenous: Inputs, deviation: Actions | None = None
    ) -> Costs:
        """J_a of each virtual episode over the hypotheses.

        State feedback plans on the twin alone, and is flown under every hypothesis as a policy is, so that the costs of
        both can be compared.
        """
        twins = [self.twins[name] for name in self.weights]
        for twin in twins:
            twin.noise = self.noise
        flights = ((twin, twin.plant.at_rest(initial_state)) for twin in twins)
        costs = [twin.episode_costs(policy, start, exogenous, deviation) for twin, start in flights]
        return initial_state.new_tensor(list(self.weights.values())) @ torch.stack(costs)


def make_twin(plant: Plant, closure: nn.Module, config: HypothesesConfig, *, engine: Engine = "native") -> DigitalTwin:
    """The twin of a plant, with the hypotheses that a configuration asks for.

    Each hypothesis begins with a copy of the closure.

    Raises:
        ValueError: if the plant suspects nothing of a name that the configuration lists, or a suspect is no
            :class:`Extension`, so that nobody knows what its closure is.
    """
    suspects = plant.suspects() if config.which == ("automatic",) else {}
    if config.which not in (("automatic",), ("none",)):
        known = {**plant.suspects(), **plant.further_suspects()}
        unknown = [name for name in config.which if name not in known]
        if unknown:
            raise ValueError(
                f"hypotheses.which: plant {plant.name!r} does not suspect {quoted(unknown)}; choose among "
                f"{quoted(known) or '(nothing)'}, or give a TwinEnsemble of your own."
            )
        suspects = {name: suspect for name, suspect in known.items() if name in config.which}
    if not suspects:
        return DigitalTwin(plant, closure, engine=engine)
    device, closures = next((w.device for w in closure.parameters()), torch.device("cpu")), dict[str, nn.Module]()
    for name, suspect in suspects.items():
        if not isinstance(suspect, Extension):
            raise ValueError(f"hypothesis {name!r} of plant {plant.name!r} must be an Extension.")
        closures[name] = suspect.extended(copy.deepcopy(closure)).to(device)
    return TwinEnsemble(plant, closure, suspects, closures, engine=engine)
