"""A safety layer between a policy and a real system: limits on what is sent, a watchdog on what comes back."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Unbounded
from torchrl.envs import EnvBase

from rt_torchrl.systems.action_limits import ActionLimits, components
from rt_torchrl.systems.around_system import AroundSystem, innermost, require_interval
from rt_torchrl.systems.safety_config import SafetyConfig
from rt_torchrl.systems.safety_report import SafetyEvent, SafetyReport

__all__ = ["WRONG", "Fallback", "SafetyConfig", "SafetyLayer"]

WRONG = frozenset({"missing", "not finite", "out of range", "frozen", "clock"})
"""Faults that make an observation wrong; a late one is right, and so is one of a system beyond its limits."""

KEPT = 16
"""Number of episodes whose reports are kept: a system may operate for years."""

Fallback = Sequence[float] | Callable[[TensorDictBase], Tensor]


class SafetyLayer(AroundSystem):
    r"""An environment with one continuous ``action``, and limits in front of it.

    Range and rate, :math:`|a_k - a_{k-1}| \le r\,\Delta t`, limit every action. They limit the fallback too, because
    they are limits of the machine. The fallback acts while the watchdog is tripped. The layer passes observations on;
    it replaces only values that are missing or not finite, by the last finite ones, because a policy cannot use NaN,
    and the event says so. It passes the system's reward on and never takes it for a fault. It adds three entries:

    ==================  ======  ======================================================================================
    ``applied``         n_a     the action sent to the system; where the system has an entry of that name, it is kept
    ``tripped``         1       whether this observation trips the watchdog, or the watchdog is still tripped
    ``refused``         1       whether this observation is wrong, and so not to be learned from, see ``WRONG``
    ==================  ======  ======================================================================================

    A learner learns from ``("next", "applied")``, not from the ``action`` that the policy asked for.
    ``ReinforcementTwinning`` learns nothing from the intervals before and after a refused observation.

    A shutdown truncates the episode and does not terminate it. Where rewards are negative costs, a return that ends
    with the shutdown would make the shutdown the policy's goal. ``ReinforcementTwinning`` needs whole episodes: leave
    ``patience`` at infinity there, and the fallback acts up to the horizon.

    The layer runs in the process that steps the system. It notices a late observation only when the observation
    arrives, and it cannot end a call that never returns. A machine needs its own protection behind it.

    Args:
        env: environment of one real system, with batch size () or (1,).
        config: limits on actions and observations.
        fallback: action within the range, or controller that makes an action from the TensorDict of the last
            observation. One with a method ``begin`` has a memory: ``begin`` is called at every reset, and the
            controller in every interval, so that its memory goes on while the policy acts and its action is not used.
        clock: wall clock [s].

    Raises:
        ValueError: if there is more than one system or action entry, the action is not continuous, the interval is not
            that of a simulation behind it, a number does not fit the actions, or ``rest`` or a constant ``fallback``
            lies outside their range.
    """

    def __init__(
        self,
        env: EnvBase,
        config: SafetyConfig,
        *,
        fallback: Fallback,
        clock: Callable[[], float] = time.monotonic,
    ):
        if env.batch_size.numel() != 1:
            raise ValueError(f"env has batch_size={tuple(env.batch_size)}; a safety layer guards one system.")
        if list(env.action_keys) != ["action"] or not env.action_spec.dtype.is_floating_point:
            raise ValueError(
                f"env has the action entries {list(env.action_keys)} of {env.action_spec}; a safety layer guards one "
                "continuous entry 'action'."
            )
        require_interval(env, config.interval)
        super().__init__(device=env.device, batch_size=env.batch_size)
        self.env, self.config = env, config
        self._clock = clock
        self.reports: deque[SafetyReport] = deque(maxlen=KEPT)
        self._episodes = 0
        self._good: dict[str, Tensor] = {}
        self.watchdog = config.watchdog()
        self._unwritten: OSError | None = None
        self._make_specs()
        self.limits = ActionLimits(
            env.action_spec, interval=config.interval, low=config.low, high=config.high, rates=config.rates
        )
        self._rest = None if config.rest is None else self.limits.sendable("rest", config.rest)
        self._following = None if config.following is None else self.limits.constant("following", config.following)
        self._fallback = fallback if callable(fallback) else self.limits.sendable("fallback", fallback)
        if config.log is not None:
            config.log.parent.mkdir(parents=True, exist_ok=True)
            config.log.touch()

    def _make_specs(self) -> None:
        observation, action = self.env.full_observation_spec.clone(), self.env.action_spec
        clock = [] if self.config.clock is None else [self.config.clock]
        named = {
            "ranges": self.config.ranges,
            "limits": self.config.limits,
            "frozen": self.config.frozen,
            "clock": clock,
        }
        for argument, entries in named.items():
            unknown = set(entries) - set(observation.keys())
            if unknown:
                raise ValueError(f"{argument} has {sorted(unknown)}; the system observes {sorted(observation.keys())}.")
        if "applied" not in observation:
            observation["applied"] = Unbounded(shape=action.shape, dtype=action.dtype, device=self.device)
        for flag in ("tripped", "refused"):
            observation[flag] = Binary(n=1, shape=(*self.batch_size, 1), dtype=torch.bool, device=self.device)
        self.observation_spec = observation
        self.action_spec, self.reward_spec = action.clone(), self.env.reward_spec.clone()
        done = self.env.full_done_spec.clone()
        if "truncated" not in done:
            done["truncated"] = done["done"].clone()
        self.done_spec = done
        self._watched = [k for k in self.env.full_observation_spec if observation[k].dtype.is_floating_point]

    @property
    def report(self) -> SafetyReport:
        """Report of the present episode; between two episodes, that of the last one, and before the first an empty one.

        A check of a protocol with a ``report`` reads it at any time.
        """
        return self.reports[-1] if self.reports else SafetyReport()

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        if self._unwritten is not None:
            error, self._unwritten = self._unwritten, None
            raise error  # now that nothing moves; in the episode the system came first
        asked = None if tensordict is None or "_reset" not in tensordict else tensordict.select("_reset")
        found = self.env.reset(asked, **kwargs).exclude("_reset")
        self.watchdog.begin()
        if hasattr(self._fallback, "begin"):
            self._fallback.begin()
        faults = self._faults(found, 0.0)
        if faults.pop("limit", None):
            self.watchdog.note(0.0, True)  # the fallback begins
        if faults:
            read = {key: found[key].flatten().tolist() for key in self._watched if key in found}
            raise ValueError(f"the system begins with a fault, {faults}: it reads {read}; nothing was sent to it.")
        self._step_count, self._passed, self._last, self._good = 0, 0, self._rest, {}
        if getattr(innermost(self.env), "reads_applied", False):
            self._last = found["applied"].clone()  # of a machine in operation
        self._remember(found)
        if "applied" not in found:
            found["applied"] = self.action_spec.zero() if self._rest is None else self._rest.clone()
        self._found = self._flag(False), self._flag(False)
        found["tripped"], found["refused"] = self._found
        found["truncated"] = found.get("truncated", self._flag(False))
        return found

    def _count_window(self) -> None:
        self._passed, self._step_count = self._passed + self._step_count, 0

    def _gone_on(self, found: TensorDictBase) -> TensorDictBase:
        """The present reading once more; what the layer has found in it, its limits and its watchdog go on."""
        found = self._remember(found.copy())
        if "applied" not in found:
            found["applied"] = self.action_spec.zero() if self._last is None else self._last.clone()
        found["tripped"], found["refused"] = self._found[0].clone(), self._found[1].clone()
        found["truncated"] = found.get("truncated", self._flag(False))
        return found

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._step_count == 0:
            # The report begins with the first step, because a reset need not be followed by a step.
            self.reports.append(SafetyReport())
            self._episodes += 1
        past = self._passed + self._step_count
        t, end = (self.config.interval * k for k in (past, past + 1))
        asked = tensordict["action"]
        applied, reasons = self._chosen(t, tensordict)
        start = self._clock()
        found = self.env.step(tensordict.exclude("next", "tripped", "refused").set("action", applied.clone()))["next"]
        faults = self._faults(found, self._clock() - start)
        self.watchdog.note(end, bool(faults))
        found = self._remember(found.copy())
        if "applied" not in self.env.full_observation_spec:
            found["applied"] = applied.clone()
        found["tripped"] = self._flag(self.watchdog.tripped(end))
        found["refused"] = self._flag(not WRONG.isdisjoint(faults))
        self._found = found["tripped"], found["refused"]
        if found["refused"].any():
            first = max(0, self._step_count - self.watchdog.samples.stale)
            self.report.wrong.update(range(first, self._step_count + 1))
        reasons |= faults | self._not_followed(applied, found["applied"])
        found["truncated"] = found.get("truncated", self._flag(False))
        if self.watchdog.exhausted(end):
            reasons["truncated"] = f"tripped for {self.watchdog.patience:g} s"
            found["truncated"], found["done"] = self._flag(True), self._flag(True)
        self._note(reasons, asked, applied)
        self._last, self._step_count = applied, self._step_count + 1
        return found

    def _chosen(self, t: float, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, str]]:
        """The action to be sent to the system, and the reasons why it is not the one that was asked for."""
        action, reasons = tensordict["action"].to(self.action_spec.dtype), {}
        if not action.isfinite().all():
            reasons["asked"] = "not finite"
            self.watchdog.note(t, True)
        tripped = self.watchdog.tripped(t)
        other = self._fallback
        if callable(other) and (tripped or hasattr(other, "begin")):
            other = other(tensordict)
        if tripped:
            action = cast(Tensor, other)
            reasons["fallback"] = "watchdog tripped"
            if action.shape != self.action_spec.shape or not action.isfinite().all():
                raise ValueError(
                    f"fallback gave {action} at t = {t:g} s; it must be finite, of shape {self.action_spec.shape}."
                )
        applied, held = self.limits(action, self._last)
        return applied, reasons | held

    def _faults(self, found: TensorDictBase, elapsed: float) -> dict[str, str]:
        """Faults of an observation by kind, each with a detail."""
        missing = [key for key in self._watched if key not in found]
        said = {"missing": f"{', '.join(missing)}, which the system declares to observe"} if missing else {}
        there = {key: found[key] for key in self._watched if key in found}
        faults = said | self.watchdog.faults(there, elapsed)
        reasons: dict[str, str] = getattr(innermost(self.env), "reasons", {})  # of a machine that says why
        if reasons and "not finite" in faults:
            faults["not finite"] += f" ({'; '.join(f'{tag}: {why}' for tag, why in reasons.items())})"
        return faults

    def _not_followed(self, sent: Tensor, applied: Tensor) -> dict[str, str]:
        """Actuators that do not do what was sent; the record holds what they have done instead."""
        if self._following is None:
            return {}
        behind = (applied - sent).abs() > self._following
        return {"actuator": components(behind)} if behind.any() else {}

    def _remember(self, found: TensorDictBase) -> TensorDictBase:
        """Replace values that are missing or not finite by the last finite ones."""
        for key in self._watched:
            value = found[key] if key in found else torch.full_like(self._good[key], torch.nan)
            good = self._good.get(key, torch.zeros_like(value))
            self._good[key] = torch.where(value.isfinite(), value, good)
            found[key] = self._good[key]
        return found

    def _note(self, reasons: dict[str, str], asked: Tensor, applied: Tensor) -> None:
        if not reasons:
            return
        wanted, sent = asked.flatten().tolist(), applied.flatten().tolist()
        t = self._step_count * self.config.interval
        event = SafetyEvent(self._episodes - 1, self._step_count, t, reasons, wanted, sent, time.time())
        self.report.events.append(event)
        self.report.counts.update(reasons.keys())
        if self.config.log is not None and self._unwritten is None:
            try:
                with self.config.log.open("a", encoding="utf-8") as file:
                    file.write(event.line() + "\n")
            except OSError as error:
                # A full disk must not stop the control of a machine that moves.
                self._unwritten = error

    def _flag(self, value: bool) -> Tensor:
        return torch.full((*self.batch_size, 1), value, dtype=torch.bool, device=self.device)

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """State of the system; the layer itself has none that outlives an episode."""
        return self.env.state_dict(*args, **kwargs)

    def load_state_dict(self, state: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        self.env.load_state_dict(state, *args, **kwargs)
