"""Step 4 for several hypotheses: each is fitted to the same records, and weighed by how well it replays them."""

import math
from collections.abc import Sequence
from typing import Any

import torch

from rt_torchrl.fit.least_squares import SHORT
from rt_torchrl.optimisers.descent import Descended
from rt_torchrl.steps.assimilate import Assimilation, SensorAssimilation
from rt_torchrl.steps.config import AssimilationConfig, HypothesesConfig
from rt_torchrl.steps.hypotheses.ensemble import ALONE, TwinEnsemble
from rt_torchrl.steps.hypotheses.fit import Fit, Turns, misfit
from rt_torchrl.steps.inputs import ExogenousProcess
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of
from rt_torchrl.trajectories.twin import DigitalTwin

PRIOR = 0.01
"""Prior weight p_h of every addition, as a share of that of the twin alone: evidence comes before anything is added."""
SHARPNESS = 6.0
"""Exponent κ of the evidence, which stands for the number of independent samples in the records."""
LEAST = 0.1
"""Weight, as a share of the greatest one, below which a hypothesis is left out of the plan."""
HOPELESS = 1e-3
"""Weight, as a share of the greatest one, below which a hypothesis is fitted in fewer episodes."""


class EnsembleAssimilation(Assimilation):
    """Fits the twin as :class:`Assimilation` does, then every hypothesis, and weighs all of them.

    Hypotheses replay the measured inputs, because draws of the inputs hide small dynamics.

    Args:
        twin: the ensemble, whose closures and weights are updated in place. Where hypotheses have weight already, they
            are fitted from the first episode on.
        config: parameters of step 4.
        hypotheses: parameters of the hypotheses.
        always: whether the twin alone is fitted in every episode, because state feedback plans on it; otherwise it
            rests as any other hypothesis that explains nothing.
    """

    def __init__(
        self,
        twin: TwinEnsemble,
        config: AssimilationConfig,
        hypotheses: HypothesesConfig,
        *,
        always: bool = False,
    ):
        super().__init__(twin, config)
        self.ensemble, self.hypotheses = twin, hypotheses
        self.segment = max(2, twin.plant.n_steps // SHORT)
        self.fits = {name: Fit(one, config, self.segment) for name, one in twin.twins.items() if name != ALONE}
        self.always, self.turns = always, Turns()
        self.misfits: dict[str, float] = {}
        self.called = not hypotheses.call or set(twin.weights) != {ALONE}
        self._before: float | None = None

    def update(
        self,
        records: Sequence[Trajectory],
        processes: Sequence[ExogenousProcess],
        count: int,
        generator: torch.Generator,
    ) -> Descended:
        """As :meth:`Assimilation.update`, and fit the hypotheses if they have been called.

        Returns:
            The result of the twin alone. Where it rests, that is its present cost, without a gradient.
        """
        self._before = self._believed_cost(records) if self.ensemble.hypothesis else None
        found = self._fit_alone(records, processes, count, generator)
        if self.called:
            self._weigh(generator)
        return found

    def _fit_alone(
        self,
        records: Sequence[Trajectory],
        processes: Sequence[ExogenousProcess],
        count: int,
        generator: torch.Generator,
    ) -> Descended:
        """Fit the twin alone if that is due, or it is planned on; its gradient is not known where it rests."""
        if self.turns.due() or self.always or ALONE in self.ensemble.weights:
            return super().update(records, processes, count, generator)
        self._records, cost = records, self.cost_of(self.in_segments(batch_of(records)))
        return Descended(cost, cost, math.nan, 0)

    def explain(self, difference: float, generator: torch.Generator) -> bool:
        """Fit the hypotheses from now on if a real episode cost other than the twin says, and no more if none helps.

        Args:
            difference: paired difference of the latest episode beyond what exploration explains.
            generator: source of random numbers.

        Returns:
            Whether they have been fitted.
        """
        wrong = difference > self.hypotheses.call or not self.hypotheses.call
        first = wrong and not self.called
        self.called = wrong or (self.called and set(self.ensemble.weights) != {ALONE})
        if first:
            self._weigh(generator)
        return first

    def _weigh(self, generator: torch.Generator) -> None:
        """Fit the hypotheses to the records of the last update, and weigh them."""
        records = self._records
        alone = misfit(self.ensemble.twins[ALONE], records, self.segment)
        misfits = {name: self._misfit(fit, records, generator) for name, fit in self.fits.items()}
        self.misfits = {ALONE: alone} | misfits
        shares = evidence(self.misfits)
        self.turns.rest(hopeless=shares[ALONE] < HOPELESS)
        for name, fit in self.fits.items():
            fit.turns.rest(hopeless=shares[name] < HOPELESS)
        self.ensemble.weights = counting(shares)

    def _misfit(self, fit: Fit, records: Sequence[Trajectory], generator: torch.Generator) -> float:
        if fit.turns.due():
            return fit.update(records, generator, self.length)
        return misfit(fit.twin, records, self.segment)

    def _believed_cost(self, records: Sequence[Trajectory]) -> float:
        """J_p of the likeliest hypothesis, not the twin alone, over what it was fitted to."""
        return self.fits[self.ensemble.likeliest].cost(records)

    def report(self) -> dict[str, float | str]:
        """The weight and the misfit of every hypothesis, and what is said of the twin where a hypothesis is believed.

        ``J_p`` is then that of the likeliest hypothesis, whose name is ``believed``, over the records of the last
        update; ``J_p_before`` is that of the one that was the likeliest before, as it was then.
        """
        found: dict[str, float | str] = {}
        for name in self.ensemble.twins:
            found[f"hypothesis/{name}"] = self.ensemble.weights.get(name, 0.0)
        found |= {f"misfit/{name}": value for name, value in self.misfits.items()}
        if self._before is not None:
            found["J_p_before"] = self._before
        if self.ensemble.hypothesis is not None and self._records:
            found |= {"J_p": self._believed_cost(self._records), "believed": self.ensemble.hypothesis}
        return {**found, **super().report()}

    def rms_errors(self, records: Sequence[Trajectory]) -> dict[str, float]:
        """RMS errors of the likeliest hypothesis; see :meth:`Assimilation.rms_errors`."""
        fit = self.fits.get(self.ensemble.likeliest)
        return super().rms_errors(records) if fit is None else fit.whole.rms_errors(fit.rested(records))

    def standard_errors(self, records: Sequence[Trajectory]) -> dict[str, float]:
        """Standard errors of the likeliest hypothesis; see :meth:`Assimilation.standard_errors`."""
        fit = self.fits.get(self.ensemble.likeliest)
        return super().standard_errors(records) if fit is None else fit.whole.standard_errors(fit.rested(records))

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {
            "fits": {name: fit.state_dict() for name, fit in self.fits.items()},
            "misfits": dict(self.misfits),
            "weights": self.ensemble.weights,
            "called": self.called,
            "alone": self.turns.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        for name, fit in self.fits.items():
            fit.load_state_dict(state["fits"][name])
        self.misfits, self.ensemble.weights = dict(state["misfits"]), state["weights"]
        self.called = state["called"]
        self.turns.load_state_dict(state.get("alone", Turns().state_dict()))  # earlier versions fitted it always


def counting(shares: dict[str, float]) -> dict[str, float]:
    """The weights of the hypotheses that are planned on."""
    return {name: share for name, share in shares.items() if share >= LEAST}


def evidence(misfits: dict[str, float]) -> dict[str, float]:
    r"""Weights :math:`w_h \propto p_h (\epsilon_{min}/\epsilon_h)^\kappa` as shares of the greatest one.

    ε is the J_p with which a hypothesis replays the records. The twin alone has all weight if none replays them.
    """
    least = min(misfits.values())
    if not least < float("inf"):
        return {name: float(name == ALONE) for name in misfits}
    tiny = 1e-300  # a misfit of zero is perfect, as is another one
    weights = {
        name: (1.0 if name == ALONE else PRIOR) * ((least + tiny) / (value + tiny)) ** SHARPNESS
        for name, value in misfits.items()
    }
    greatest = max(weights.values())
    return {name: weight / greatest for name, weight in weights.items()}


def make_assimilation(
    twin: DigitalTwin, config: AssimilationConfig, hypotheses: HypothesesConfig, *, always: bool = False
) -> Assimilation:
    """Step 4 for a twin, or for an ensemble of them.

    Args:
        twin: the twin.
        config: parameters of step 4.
        hypotheses: parameters of the hypotheses.
        always: whether the twin alone is fitted in every episode; see :class:`EnsembleAssimilation`.

    Raises:
        ValueError: if hypotheses are to be fitted to some sensors alone, or the plant has no such sensor.
    """
    if config.sensors and isinstance(twin, TwinEnsemble):
        raise ValueError(
            f"sensors={config.sensors} of the assimilation do not go with hypotheses, which replay "
            "the whole state; leave the sensors out, or the hypotheses by hypotheses.which=none."
        )
    if config.sensors:
        return SensorAssimilation(twin, config)
    if isinstance(twin, TwinEnsemble):
        return EnsembleAssimilation(twin, config, hypotheses, always=always)
    return Assimilation(twin, config)
