"""The result of an identification from sensors, as ``metrics.json`` and the terminal show it."""

import math
from collections.abc import Mapping
from typing import Any

from rt_torchrl.fit.sensor_identification import SensorIdentified


def metrics_of_sensors(found: SensorIdentified) -> dict[str, Any]:
    """Errors of every sensor, weights with their uncertainty, noise levels and initial states; unknown is null."""
    estimate = found.estimate
    sensors, states = estimate.likelihood.sensors, estimate.likelihood.plant.states
    summary: dict[str, Any] = {"iterations": estimate.iterations, "prior": estimate.stiffness}
    for side in ("training", "held_out"):
        before, after = getattr(found, side)
        summary[side] = {
            "rms": {
                sensor.name: {
                    "unit": sensor.measurement.unit,
                    "before": _number(before.rms[k].item()),
                    "after": _number(after.rms[k].item()),
                }
                for k, sensor in enumerate(sensors)
            }
        }
    names = [sensor.name for sensor in sensors]
    summary["autocorrelation"] = dict(zip(names, map(_number, found.autocorrelation.tolist()), strict=True))
    summary["noise"], summary["bias"] = estimate.noise, estimate.biases
    errors, intervals = estimate.uncertainty.standard_errors(), estimate.uncertainty.intervals()
    summary["weights"] = {
        name: {
            "before": estimate.before[name],
            "after": value,
            "standard_error": _number(errors[name]),
            "interval": [_number(end) for end in intervals[name]],
        }
        for name, value in estimate.after.items()
    }
    first, scatter = estimate.initial.tolist(), estimate.uncertainty.initial_errors().tolist()
    summary["initial_states"] = [
        {state.name: [value, _number(error)] for state, value, error in zip(states, *pair, strict=True)}
        for pair in zip(first, scatter, strict=True)
    ]
    return summary | {"warnings": estimate.uncertainty.warnings()}


def table_of_sensors(metrics: dict[str, Any]) -> str:
    """The results, for the terminal."""
    lines = [f"  {'':<32}{'before':>12}{'after':>12}"]
    for side in ("training", "held_out"):
        lines.append(f"  RMS errors, {side.replace('_', ' ')}")
        for sensor, rms in metrics[side]["rms"].items():
            label = f"{sensor} [{rms['unit']}]"
            lines.append(f"    {label:<30}{_shown(rms['before']):>12}{_shown(rms['after']):>12}")
    levels = ", ".join(f"{name} {value:.3g}" for name, value in metrics["noise"].items())
    lines.append(f"  noise of the sensors: {levels}")
    biases = ", ".join(f"{name} {value:.3g}" for name, value in metrics["bias"].items() if value)
    lines += [f"  bias of the sensors: {biases}"] if biases else []
    correlation = ", ".join(f"{name} {_shown(value)}" for name, value in metrics["autocorrelation"].items())
    lines.append(f"  correlation of neighbouring residuals: {correlation}")
    lines += weight_lines(metrics["weights"])
    lines += [f"  note: {warning}" for warning in metrics["warnings"]]
    return "\n".join(lines)


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _shown(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.4g}"


def weight_lines(weights: Mapping[str, Any]) -> list[str]:
    """A line for each weight of a closure, before and after, with its standard error."""
    lines = [f"  {'weight':<32}{'before':>12}{'after':>12}{'std. error':>12}"]
    for name, entry in weights.items():
        error = "not shown" if entry["standard_error"] is None else f"{entry['standard_error']:.2g}"
        lines.append(f"  {name:<32}{entry['before']:>12.5g}{entry['after']:>12.5g}{error:>12}")
    return lines
