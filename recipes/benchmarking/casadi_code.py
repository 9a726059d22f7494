"""Trajectory, cost and gradient of the drone as C code that CasADi derives and gcc compiles.

CasADi writes one interval of the closed loop and its vector-Jacobian product as C. The loops over intervals and
realisations around them, forward with the states kept and backward over them, are written by hand, as somebody would
write them who wants the fastest gradient that CasADi can give.
"""

import ctypes
import functools
import math
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

import casadi as ca
import numpy as np
import torch
from torch import nn

from benchmarking.case import System
from rt_torchrl import Scenario
from rt_torchrl.envs.flapping_wing.plant import WINDOW_WIDTH, FlappingWing

Method = Literal["scalar", "lanes"]
LANES = 8
"""Realisations that the method ``lanes`` computes at once; gcc takes one or two vectors for them."""
NUMBERS: dict[Method, str] = {
    "scalar": """
#define LANES 1
using number = double;
static inline number load(const double* x) { return *x; }
static inline void store(number y, double* x) { *x = y; }
""",
    "lanes": """
#include <experimental/simd>
#define LANES 8
using number = std::experimental::fixed_size_simd<double, LANES>;
#define casadi_real number
static inline number load(const double* x) { return number(x, std::experimental::element_aligned); }
static inline void store(number y, double* x) { y.copy_to(x, std::experimental::element_aligned); }
""",
}
"""The type of number in CasADi's code: one realisation, or a vector over realisations."""
LOOPS = """
#define S {n_s}
#define Z {n_z}
#define W {n_w}
extern "C" void forward(int n, int batch, double dt, const double* z, const double* w, double* states, double* costs) {{
  number weights[W];
  for (int i = 0; i < W; ++i) weights[i] = w[i];
  for (int b = 0; b < batch; b += LANES) {{
    number state[S], input[Z], out[S], cost, sum = 0.0;
    for (int i = 0; i < S; ++i) state[i] = load(states + (size_t)i*batch + b);
    for (int k = 0; k < n; ++k) {{
      const number t = k*dt;
      for (int i = 0; i < Z; ++i) input[i] = load(z + ((size_t)k*Z + i)*batch + b);
      const number* arg[] = {{&t, state, input, weights}};
      number* res[] = {{out, &cost}};
      interval(arg, res, 0, 0, 0);
      for (int i = 0; i < S; ++i) store(state[i] = out[i], states + ((size_t)(k + 1)*S + i)*batch + b);
      sum += cost;
    }}
    store(sum, costs + b);
  }}
}}
extern "C" void backward(int n, int batch, double dt, const double* z, const double* w, const double* states,
                         const double* share, double* gradients) {{
  static number weights[W], part[W], gradient[W];
  for (int i = 0; i < W; ++i) weights[i] = w[i];
  for (int b = 0; b < batch; b += LANES) {{
    number state[S], input[Z], costate[S], before[S];
    const number shares = load(share + b);
    for (int i = 0; i < S; ++i) costate[i] = 0.0;
    for (int i = 0; i < W; ++i) gradient[i] = 0.0;
    for (int k = n - 1; k >= 0; --k) {{
      const number t = k*dt;
      for (int i = 0; i < Z; ++i) input[i] = load(z + ((size_t)k*Z + i)*batch + b);
      for (int i = 0; i < S; ++i) state[i] = load(states + ((size_t)k*S + i)*batch + b);
      const number* arg[] = {{&t, state, input, weights, costate, &shares}};
      number* res[] = {{before, part}};
      interval_vjp(arg, res, 0, 0, 0);
      for (int i = 0; i < S; ++i) costate[i] = before[i];
      for (int i = 0; i < W; ++i) gradient[i] += part[i];
    }}
    for (int i = 0; i < W; ++i) store(gradient[i], gradients + (size_t)i*batch + b);
  }}
}}
"""


class Inputs(NamedTuple):
    """Initial states ``n_s batch``, exogenous inputs ``n n_z batch``, and the number of realisations that count."""

    initial_state: np.ndarray
    exogenous: np.ndarray
    realisations: int


class CasadiCode:
    """Forward and gradient of J_a by the policy's weights, for the drone.

    Args:
        system: plant, closure and policy, whose weights are taken over.
        method: ``scalar`` calls the code of one interval for one realisation after another; ``lanes`` lets gcc make
            vectors of the loop over realisations.

    Raises:
        ValueError: for another plant.
    """

    def __init__(self, system: System, method: Method):
        if not isinstance(system.plant, FlappingWing):
            raise ValueError(f"plant {system.plant.name!r} is not written in CasADi; choose flapping_wing.")
        self.dt, self.policy, self.lanes = system.plant.dt, system.policy, LANES if method == "lanes" else 1
        self.sizes = (len(system.plant.states), len(system.plant.inputs), sum(w.numel() for w in self.weights()))
        self.library = compiled(*functions(system.plant, system.closure, system.policy), self.sizes, method)

    def weights(self) -> list[nn.Parameter]:
        return list(self.policy.parameters())

    def inputs(self, scenario: Scenario) -> Inputs:
        """The scenario with the time first and the realisations last, filled up with copies to whole vectors."""
        batch = len(scenario.initial_state)
        rows = torch.arange(batch + -batch % self.lanes) % batch
        exogenous = np.ascontiguousarray(scenario.exogenous[rows].permute(1, 2, 0).numpy())
        return Inputs(np.ascontiguousarray(scenario.initial_state[rows].T.numpy()), exogenous, batch)

    def forward(self, inputs: Inputs) -> tuple[float, np.ndarray]:
        """Mean cost, and the states at all times, ``n+1 n_s batch``."""
        cost, states = self._forward(inputs, self._flat_weights())
        return cost, states[..., : inputs.realisations]

    def gradient(self, inputs: Inputs) -> tuple[float, np.ndarray]:
        """Mean cost and its gradient by the policy's weights, flat in their order."""
        weights = self._flat_weights()
        cost, states = self._forward(inputs, weights)
        n, _, batch = inputs.exogenous.shape
        share, gradients = np.zeros(batch), np.empty((self.sizes[2], batch))
        share[: inputs.realisations] = 1.0 / (n * inputs.realisations)
        arrays = (inputs.exogenous, weights, states, share, gradients)
        self.library.backward(n, batch, ctypes.c_double(self.dt), *map(_pointer, arrays))
        return cost, gradients.sum(1)

    def _forward(self, inputs: Inputs, weights: np.ndarray) -> tuple[float, np.ndarray]:
        n, _, batch = inputs.exogenous.shape
        states, costs = np.empty((n + 1, *inputs.initial_state.shape)), np.empty(batch)
        states[0] = inputs.initial_state
        arrays = (inputs.exogenous, weights, states, costs)
        self.library.forward(n, batch, ctypes.c_double(self.dt), *map(_pointer, arrays))
        return costs[: inputs.realisations].mean() / n, states

    def _flat_weights(self) -> np.ndarray:
        return np.concatenate([w.detach().numpy().ravel() for w in self.weights()])


def _pointer(values: np.ndarray) -> ctypes.c_void_p:
    return values.ctypes.data_as(ctypes.c_void_p)


def compiled(interval: ca.Function, vjp: ca.Function, sizes: tuple[int, int, int], method: Method) -> ctypes.CDLL:
    """The loops around the code of one interval, as a shared library."""
    n_s, n_z, n_w = sizes
    with tempfile.TemporaryDirectory() as folder:
        generator = ca.CodeGenerator("interval.c", {"with_header": False})
        generator.add(interval)
        generator.add(vjp)
        generator.generate(f"{folder}/")
        code = Path(folder, "interval.c").read_text(encoding="utf-8")
        # All functions become static: gcc inlines none that it has to export.
        code = code.replace("\ncasadi_real casadi_sq", "\nstatic casadi_real casadi_sq")
        start = "#include <cmath>\n#include <cstddef>\n#define CASADI_SYMBOL_EXPORT static\n" + NUMBERS[method]
        source, library = Path(folder, "loops.cpp"), Path(folder, "loops.so")
        source.write_text(start + code + LOOPS.format(n_s=n_s, n_z=n_z, n_w=n_w), encoding="utf-8")
        command = ["g++", "-std=c++17", "-O3", "-march=native", "-shared", "-fPIC", "-o", str(library), str(source)]
        subprocess.run(command, check=True, capture_output=True)
        return ctypes.CDLL(str(library))


def functions(plant: FlappingWing, closure: nn.Module, policy: nn.Module) -> tuple[ca.Function, ca.Function]:
    """One interval, (t, s, z, w) to the end state and the running cost, and its vector-Jacobian product by s and w."""
    t, state, z = ca.SX.sym("t"), ca.SX.sym("s", len(plant.states)), ca.SX.sym("z", len(plant.inputs))
    weights = ca.SX.sym("w", sum(w.numel() for w in policy.parameters()))
    target, scale = plant.target.numpy(), np.array([measurement.scale for measurement in plant.observed])
    error = target - state[:2]
    action = saturated(policy, weights, ca.vertcat(error, -state[2:]) / scale)
    field = functools.partial(vector_field, plant, coefficients(closure))
    end = rk4_step(lambda t, s: field(t, s, action, z), t, state, plant.dt)
    window = ca.exp(-0.5 * (error / WINDOW_WIDTH) ** 2)
    cost = 0.5 * (ca.sumsqr(error) + ca.sumsqr(state[2:] * window))
    costate, share = ca.SX.sym("l", len(plant.states)), ca.SX.sym("share")
    products = ca.jtimes(ca.vertcat(end, cost), ca.vertcat(state, weights), ca.vertcat(costate, share), True)
    by_state, by_weights = ca.vertsplit(products, [0, len(plant.states), products.numel()])
    step = ca.Function("interval", [t, state, z, weights], ca.cse([end, cost]))
    back = ca.Function("interval_vjp", [t, state, z, weights, costate, share], ca.cse([by_state, by_weights]))
    return step, back


def rk4_step(field: Callable[[ca.SX, ca.SX], ca.SX], t: ca.SX, state: ca.SX, dt: float) -> ca.SX:
    """One step of Kutta's 3/8 rule."""
    third = dt / 3.0
    k1 = field(t, state)
    k2 = field(t + third, state + third * k1)
    k3 = field(t + 2.0 * third, state + dt * k2 - third * k1)
    k4 = field(t + dt, state + dt * (k1 - k2 + k3))
    return state + (k1 + 3.0 * (k2 + k3) + k4) * (dt / 8.0)


def vector_field(
    plant: FlappingWing, closure: Callable[[ca.SX, ca.SX], tuple[ca.SX, ca.SX]], t: ca.SX, state: ca.SX, action: ca.SX,
    z: ca.SX,
) -> ca.SX:  # fmt: skip
    """The drone's equations; ``envs/flapping_wing/plant.py`` explains them."""
    radius, strip_mass = plant.radius.numpy(), plant.strip_mass.numpy()
    mass, weight = float(plant.mass), float(plant.weight[1])
    rate, epsilon = 2.0 * math.pi * plant.frequency, plant.smallest_airspeed**2
    v_x, v_z = state[2] + z[0], state[3]
    A_phi, beta_w = action[0] * (math.pi / 180.0), action[1] * (math.pi / 180.0)
    sine, cosine = ca.sin(rate * t), ca.cos(rate * t)
    cos_phi, phi_dot = ca.cos(A_phi * cosine), -rate * A_phi * sine
    sin_beta, cos_beta = ca.sin(beta_w), ca.cos(beta_w)
    stroke_x, stroke_z = cos_beta * v_x + sin_beta * v_z, cos_beta * v_z - sin_beta * v_x
    alpha = math.radians(plant.pitching_amplitude) * sine
    sin_alpha, cos_alpha = ca.sin(alpha), ca.cos(alpha)
    F_x = F_z = ca.SX(0.0)
    for r, m in zip(radius, strip_mass, strict=True):
        U_x, U_z = cos_phi * stroke_x - phi_dot * float(r), stroke_z
        U_xi, U_zeta = cos_alpha * U_x - sin_alpha * U_z, sin_alpha * U_x + cos_alpha * U_z
        speed = ca.sqrt(U_x**2 + U_z**2 + epsilon)
        C_L, C_D = closure(U_xi / speed, U_zeta / speed)
        pressure = float(m) * speed
        F_x -= pressure * (C_D * U_x + C_L * U_z)
        F_z += pressure * (C_L * U_x - C_D * U_z)
    drag = 0.5 * plant.air_density * plant.body_drag_area * ca.sqrt(v_x**2 + v_z**2 + epsilon)
    force_x = cos_beta * cos_phi * F_x - sin_beta * F_z - drag * v_x
    force_z = sin_beta * cos_phi * F_x + cos_beta * F_z - drag * v_z
    return ca.vertcat(state[2], state[3], force_x / mass, (force_z + weight) / mass)


def coefficients(closure: nn.Module) -> Callable[[ca.SX, ca.SX], tuple[ca.SX, ca.SX]]:
    """C_L and C_D of the law, whose weights are numbers in the code.

    Raises:
        ValueError: for a closure with a perceptron.
    """
    names = [name for name, _ in closure.named_parameters()]
    if names != ["log_coefficients"]:
        raise ValueError(f"closure with weights {names} is not written in CasADi; choose closure law.")
    a, b, c = closure.get_parameter("log_coefficients").detach().exp().tolist()
    return lambda sine, cosine: (2.0 * a * sine * cosine, b + 2.0 * c * sine**2)


def saturated(policy: nn.Module, weights: ca.SX, x: ca.SX) -> ca.SX:
    """The policies ``SaturatedAffine`` and ``SaturatedMLP`` of symbolic weights, flat in their order."""
    ends = np.cumsum([0, *(w.numel() for w in policy.parameters())]).tolist()
    parts = ca.vertsplit(weights, ends)
    shapes = [tuple(w.shape) for w in policy.parameters()]
    for place, (part, shape) in enumerate(zip(parts, shapes, strict=True)):
        if len(shape) == 2:  # a matrix, row by row
            x = ca.reshape(part, shape[1], shape[0]).T @ x
        else:
            x = x + part
            if place + 1 < len(parts):
                x = ca.tanh(x)
    clip = policy.get_submodule("clip")
    low, high = clip.get_buffer("low").numpy(), clip.get_buffer("high").numpy()
    return 0.5 * (ca.tanh(x) + 1.0) * (high - low) + low
