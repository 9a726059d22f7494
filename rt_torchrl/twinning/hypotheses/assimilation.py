"""Step 4 for several hypotheses: each is fitted to the same records, and weighed by how well it replays them."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from rt_torchrl.optimisers.descent import Descended
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.trajectory import Trajectory, identification_cost
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.assimilation import Assimilation, AssimilationConfig
from rt_torchrl.twinning.exogenous import ExogenousProcess
from rt_torchrl.twinning.findings import findings
from rt_torchrl.twinning.hypotheses.config import HypothesesConfig
from rt_torchrl.twinning.hypotheses.ensemble import ALONE, TwinEnsemble


class EnsembleAssimilation(Assimilation):
    """Fits the twin as :class:`Assimilation` does, then every hypothesis, and weighs all of them.

    The hypotheses are fitted under the measured inputs, because draws of the inputs hide small dynamics.

    Args:
        twin: the ensemble, whose closures and weights are updated in place.
        config: parameters of step 4.
        hypotheses: parameters of the weights.
    """

    def __init__(self, twin: TwinEnsemble, config: AssimilationConfig, hypotheses: HypothesesConfig):
        super().__init__(twin, config)
        self.ensemble, self.hypotheses = twin, hypotheses
        twin.risk = hypotheses.risk
        measured = dataclasses.replace(config, inputs="record")
        self.fits = {name: Assimilation(one, measured) for name, one in twin.twins.items() if name != ALONE}
        self.misfits: dict[str, float] = {}

    def update(
        self,
        records: Sequence[Trajectory],
        processes: Sequence[ExogenousProcess],
        count: int,
        generator: torch.Generator,
    ) -> Descended:
        """As :meth:`Assimilation.update`, whose report is that of the twin alone."""
        found = super().update(records, processes, count, generator)
        for fit in self.fits.values():
            try:
                fit.update([self._lifted(fit.twin, record) for record in records], processes, count, generator)
            except FloatingPointError:
                continue  # it keeps its closure, and its misfit says what that is worth
        self.misfits = {name: misfit(twin, records) for name, twin in self.ensemble.twins.items()}
        self.ensemble.weights = weighed(self.misfits, self.hypotheses)
        return found

    def _lifted(self, twin: DigitalTwin, record: Trajectory) -> Trajectory:
        """A record with hidden states: those of a replay, because a segment of the record begins with them."""
        states = twin.plant.at_rest(record.states)
        if self.config.segment:
            with torch.no_grad():
                replayed = twin.replay(states[:1], record.exogenous[None], record.actions[None]).states[0]
            states = torch.cat([record.states, replayed[:, record.states.shape[-1] :]], -1)
        return record._replace(states=states)

    def retreat(self) -> None:
        """Leave every hypothesis out for this episode: the policy that has just flown diverges under one."""
        self.ensemble.weights = {ALONE: 1.0}

    def report(self) -> TensorDict:
        """The weight and the misfit of every hypothesis."""
        shares = {f"hypothesis/{name}": self.ensemble.weights.get(name, 0.0) for name in self.ensemble.twins}
        return findings(**shares, **{f"misfit/{name}": value for name, value in self.misfits.items()})

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {
            "fits": {name: fit.state_dict() for name, fit in self.fits.items()},
            "closures": {name: fit.twin.closure.state_dict() for name, fit in self.fits.items()},
            "misfits": dict(self.misfits),
            "weights": self.ensemble.weights,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        for name, fit in self.fits.items():
            fit.load_state_dict(state["fits"][name])
            fit.twin.closure.load_state_dict(state["closures"][name])
        self.misfits, self.ensemble.weights = dict(state["misfits"]), state["weights"]


@torch.no_grad()
def misfit(twin: DigitalTwin, records: Sequence[Trajectory]) -> float:
    """Mean J_p with which a twin replays whole records under the measured inputs; infinite if it diverges."""
    read, actions, exogenous = (torch.stack(parts) for parts in zip(*(record[:3] for record in records), strict=True))
    states = twin.plant.at_rest(read)
    try:
        flown = twin.replay(states[:, 0], exogenous, actions)
    except DivergenceError:
        return float("inf")
    found: Tensor = identification_cost(twin.plant, flown, states).mean()
    return found.item()


def weighed(misfits: dict[str, float], config: HypothesesConfig) -> dict[str, float]:
    """Weights of the hypotheses that are planned on; the twin alone if none replays the records."""
    least = min(misfits.values())
    if not least < float("inf"):
        return {ALONE: 1.0}
    tiny = 1e-300  # a misfit of zero is perfect, as is another one
    shares = {
        name: (1.0 if name == ALONE else config.prior) * ((least + tiny) / (value + tiny)) ** config.sharpness
        for name, value in misfits.items()
    }
    greatest = max(shares.values())
    return {name: share for name, share in shares.items() if share >= config.least * greatest}
