"""The gradient descent of steps 4 and 5, which takes a few iterations at a time and keeps the best weights."""

import contextlib
import copy
import math
from collections.abc import Callable, Iterable
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils import get_total_norm

from rt_torchrl.interruption import safe_point
from rt_torchrl.options import Limit, NotNegative, Positive, configuration

Optimiser = Literal["adam", "lbfgs"]


@configuration
class DescentConfig:
    r"""How weights descend a cost that is deterministic within an episode.

    The cost is divided by its value at the start of the episode, so that no parameter depends on a plant's units.

    Adam's second moment forgets within about ten steps (β₂ = 0.9), because the gradient of a policy that starts in
    saturation or stall is hundreds of times larger than later ones. With the usual 0.999 that first gradient keeps the
    steps near zero for the rest of a training of some hundred steps.

    Args:
        optimiser: ``adam``, or ``lbfgs`` with a strong-Wolfe line search, each of whose trials counts as an iteration.
        rate: learning rate of Adam; first step length of L-BFGS.
        gradient_limit: greatest norm of the (relative) gradient that Adam sees, infinite for no limit; L-BFGS has
            its line search instead.
        tolerance: decrease of the (relative) cost in a step of L-BFGS, or greatest change of a weight, below which
            L-BFGS stops early; Adam never does.
    """

    optimiser: Optimiser = "adam"
    rate: Positive = 0.1
    gradient_limit: Limit = 1.0
    tolerance: NotNegative = 1e-9


class Descended(NamedTuple):
    """Cost at the start and at the best weights, norm of its first gradient (not relative), and iterations."""

    start: float
    best: float
    gradient: float
    iterations: int


def limited_mean(costs: Float[Tensor, " episodes"], weights: Iterable[Tensor], limit: float) -> Float[Tensor, ""]:
    r"""The mean of costs, with a limit for the gradient of each.

    With :math:`g_i = \partial J_i/\partial w` the gradient is

    .. math:: \frac1N\sum_i g_i\min\Bigl(1, \frac{\kappa\,|J_i|}{\|w\|\,\|g_i\|}\Bigr)

    where κ is the limit: a gradient is too long if it says that the cost changes by itself when the weights change by
    less than a share 1/κ of their norm. Where a closed loop is unstable for a while, small differences grow
    exponentially, and so do gradients, although the cost hardly changes. Such an episode would decide on the direction
    of a descent alone.

    Args:
        costs: costs J of the episodes, which depend on each weight.
        weights: weights w by which the mean is differentiated.
        limit: limit κ; infinite for the mean as it is.

    Returns:
        The mean, differentiable once by the weights and by nothing else if there is a limit.
    """
    if math.isinf(limit) or not costs.requires_grad:
        return costs.mean()
    weights = [w for w in weights if w.requires_grad]
    gradients = [torch.autograd.grad(cost, weights, retain_graph=True, materialize_grads=True) for cost in costs]
    slopes = [torch.stack(parts) for parts in zip(*gradients, strict=True)]
    norms = torch.stack([part.reshape(len(costs), -1).norm(dim=1) for part in slopes]).norm(dim=0)
    allowed = limit * costs.detach().abs() / get_total_norm([weight.detach() for weight in weights])
    # A cost of zero says nothing about what is long.
    shares = torch.where((norms > allowed) & (allowed > 0.0), allowed / norms, 1.0)
    mean = costs.detach().mean()
    for weight, part in zip(weights, slopes, strict=True):
        slope = torch.tensordot(shares, part, 1) / len(costs)
        mean = mean + ((weight - weight.detach()) * slope).sum()
    return mean


class Descent:
    """Updates the weights of a module in place and leaves the best weights in it.

    The cost diverges where it raises ``FloatingPointError``, or where cost or gradient is not finite. A step to such
    weights is halved until the cost does not diverge; every such trial counts as an iteration.

    Args:
        module: module with the weights.
        config: options of the descent.
        second_moment: β₂ of Adam.
    """

    _optimiser: torch.optim.Optimizer

    def __init__(self, module: nn.Module, config: DescentConfig, *, second_moment: float = 0.9):
        self.module, self.config, self.second_moment = module, config, second_moment
        self.restart()

    def restart(self) -> None:
        """Forget the optimiser's state, because the weights have jumped."""
        weights = [w for w in self.module.parameters() if w.requires_grad]
        if self.config.optimiser == "adam":
            self._optimiser = torch.optim.Adam(weights, lr=self.config.rate, betas=(0.9, self.second_moment))
        else:
            self._optimiser = torch.optim.LBFGS(
                weights, lr=self.config.rate, tolerance_change=self.config.tolerance, line_search_fn="strong_wolfe"
            )

    def run(self, cost: Callable[[], Tensor], iterations: int, *, stop_below: float = -math.inf) -> Descended:
        """Take ``iterations`` gradients of ``cost`` and keep the best weights.

        Args:
            cost: function that returns the scalar cost at the module's present weights; it stays the same in a run.
            iterations: number of gradients; 0 does nothing.
            stop_below: cost below which the run stops early.

        Raises:
            FloatingPointError: if the cost diverges at the weights that the descent starts from.
        """
        trials = _Trials(self, cost, iterations, stop_below)
        try:
            if self.config.optimiser == "lbfgs":
                # Another episode has another cost: the curvature of the last one would mislead the line search.
                self.restart()
                self._optimiser.param_groups[0].update(max_iter=iterations, max_eval=iterations)
                self._optimiser.step(trials)  # its line search has evaluated the weights that it ends at
            else:
                for _ in range(iterations):
                    if math.isfinite(trials()):
                        self._optimiser.step()
                    else:
                        trials.halve_step()
                trials.note_last()
        except _Finished:
            pass
        self.module.load_state_dict(trials.best_weights)
        return Descended(trials.start, trials.best, trials.gradient, trials.count)

    def state_dict(self) -> dict[str, Any]:
        return self._optimiser.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._optimiser.load_state_dict(state)


class _Finished(Exception):
    """The run has ended, although the optimiser would go on."""


class _Trials:
    """The function that an optimiser calls for cost and gradient; it remembers the best weights."""

    def __init__(self, descent: Descent, cost: Callable[[], Tensor], iterations: int, stop_below: float):
        module, config = descent.module, descent.config
        self._module, self._cost = module, cost
        self._limit = config.gradient_limit if config.optimiser == "adam" else math.inf
        self._iterations, self._stop_below = iterations, stop_below
        self.start = self.best = math.nan
        self.gradient, self.count = math.nan, 0
        self.best_weights = copy.deepcopy(module.state_dict())
        self._weights = [w for w in module.parameters() if w.requires_grad]
        self._sound: list[Tensor] = []  # weights of the last cost that was finite

    def __call__(self) -> float:
        """The cost over that at the start, with its gradient; infinite, with NaN for the gradient, where it diverges.

        The square of an exploding gradient overflows, and leaves L-BFGS without a direction: whatever it would try from
        then on is NaN, so that the run ends. Where a slope is NaN, its line search halves its bracket.

        Raises:
            FloatingPointError: if the first cost diverges.
        """
        stray = self.count and not all(w.isfinite().all() for w in self._weights)
        if stray or self.count == self._iterations:
            raise _Finished
        safe_point()
        try:
            with torch.enable_grad():
                self._module.zero_grad(set_to_none=True)
                cost = self._cost()
                value = cost.item()
                if self.count == 0:
                    self.start = value
                # A cost that starts at zero is no unit for later ones, which then keep their own.
                relative = cost / (abs(self.start) or 1.0)
                relative.backward()
            weights = [w for w in self._module.parameters() if w.grad is not None]
            norm = nn.utils.clip_grad_norm_(weights, self._limit).item()
            if not (math.isfinite(value) and math.isfinite(norm)):
                raise FloatingPointError(
                    f"cost={value:g} of {type(self._module).__name__} with a relative gradient of norm {norm:g} is not "
                    "finite; start the descent from weights whose cost and gradient are."
                )
        except FloatingPointError:
            if self.count == 0:
                raise
            self.count += 1
            for weight in self._weights:
                weight.grad = torch.full_like(weight, math.nan)
            return math.inf
        if self.count == 0:
            self.gradient = norm * (abs(self.start) or 1.0)
        self._sound = [w.detach().clone() for w in self._weights]
        self.count += 1
        self._note(value)
        return relative.item()

    @torch.no_grad()
    def halve_step(self) -> None:
        """Go half the way back to the last weights with a finite cost."""
        for weight, sound in zip(self._weights, self._sound, strict=True):
            weight.lerp_(sound, 0.5)

    @torch.no_grad()
    def note_last(self) -> None:
        """Consider the weights of Adam's last step too; Adam has not evaluated them."""
        if self.count:
            with contextlib.suppress(FloatingPointError):  # these are not the best weights
                self._note(self._cost().item())

    def _note(self, cost: float) -> None:
        # Weights that are not finite in single precision are of no use to anybody.
        lower = cost < self.best and all(weight.float().isfinite().all() for weight in self._weights)
        if lower or math.isnan(self.best):
            self.best, self.best_weights = cost, copy.deepcopy(self._module.state_dict())
        if cost < self._stop_below:
            raise _Finished
