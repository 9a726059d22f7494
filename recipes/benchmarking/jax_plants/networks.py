"""Policies and perceptrons of the library in JAX; weights have the names that they have in PyTorch."""

from collections.abc import Callable

import jax.numpy as jnp
from torch import nn

from benchmarking.jax_plants.jax_plant import Array, Weights
from rt_torchrl import BoundedPerceptron


def column(values: Array) -> Array:
    """A vector over the components, as a column that goes with any number of realisations."""
    return jnp.asarray(values)[:, None]


def linear(weights: Weights, prefix: str, x: Array) -> Array:
    """W x + b; without b if the layer has none."""
    product = weights[f"{prefix}weight"] @ x
    return product + weights[f"{prefix}bias"][:, None] if f"{prefix}bias" in weights else product


def perceptron(weights: Weights, prefix: str, x: Array) -> Array:
    """The layers of an ``nn.Sequential`` of linear layers with tanh between them."""
    last = max(int(name.removeprefix(prefix).split(".")[0]) for name in weights if name.startswith(prefix))
    for layer in range(0, last, 2):
        x = jnp.tanh(linear(weights, f"{prefix}{layer}.", x))
    return linear(weights, f"{prefix}{last}.", x)


def smooth_clip(clip: nn.Module) -> Callable[[Array], Array]:
    """The saturation of a ``SmoothClip``."""
    low, high = (column(end.numpy()) for end in (clip.get_buffer("low"), clip.get_buffer("high")))
    return lambda x: 0.5 * (jnp.tanh(x) + 1.0) * (high - low) + low


def saturated(clip: Callable[[Array], Array]) -> dict[str, Callable[[Weights, Array], Array]]:
    """The policies ``SaturatedAffine`` and ``SaturatedMLP``."""
    return {
        "affine": lambda weights, e: clip(linear(weights, "linear.", e)),
        "mlp": lambda weights, e: clip(perceptron(weights, "network.", e)),
    }


def bounded_perceptron(module: BoundedPerceptron | None) -> Callable[[Weights, Array], Array] | None:
    """The correction of a neural closure; None if the closure has none."""
    if module is None:
        return None
    middle, half_range, bound = (column(b.numpy()) for b in (module.middle, module.half_range, module.bound))
    prefix = "correction.network."
    return lambda weights, x: bound * jnp.tanh(perceptron(weights, prefix, (x - middle) / half_range))
