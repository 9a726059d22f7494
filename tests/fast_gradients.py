"""The drone in JAX and as CasADi's C code beside the engines: ``uv run --group nightly tests/fast_gradients.py``.

Both are written as somebody would write them who wants the fastest gradient that they can give. ``jax`` is a reverse
sweep that recomputes each interval, jitted. ``casadi`` is CasADi's C code of one interval and of its vector-Jacobian
product, in loops by hand, for one realisation after another; ``casadi_lanes`` is the same with vectors of C++ over
eight realisations in the place of numbers. ``envs/flapping_wing/plant.py`` explains the equations.
"""

import ctypes
import math
import subprocess
import sys
import tempfile
from pathlib import Path

import casadi as ca
import jax
import jax.numpy as jnp
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "recipes"))  # where benchmark is

from benchmark import Calls, Config, System, main

from rt_torchrl import main_of
from rt_torchrl.envs.flapping_wing.plant import WINDOW_WIDTH


def jax_drone(system: System):
    """Cost and gradient in JAX, with components first and realisations last."""
    jax.config.update("jax_enable_x64", True)
    plant, dt, torch_weights = system.plant, system.plant.dt, list(system.policy.parameters())
    target = jnp.asarray(plant.target.numpy())[:, None]
    scale = jnp.asarray([measurement.scale for measurement in plant.observed])[:, None]

    def interval(weights, t, state, z):
        """The end state and the running cost."""
        error = target - state[:2]
        action = jax_policy(system, weights, jnp.concatenate([error, -state[2:]]) / scale)
        window = jnp.exp(-0.5 * (error / WINDOW_WIDTH) ** 2)
        cost = 0.5 * ((error**2).sum(0) + ((state[2:] * window) ** 2).sum(0))
        return rk4_step(lambda t, s: jax_field(system, t, s, action, z), t, state, dt), cost

    def flown(weights, initial, times, exogenous):
        def body(state, given):
            end, cost = interval(weights, given[0], state, given[1])
            return end, (end, cost)

        return jax.lax.scan(body, initial, (times, exogenous))[1]

    @jax.jit
    def cost_of(weights, *scenario):
        return flown(weights, *scenario)[1].mean()

    @jax.jit
    def gradient_of(weights, initial, times, exogenous):
        ends, costs = flown(weights, initial, times, exogenous)

        def body(carry, given):
            t, z, state = given
            _, pull = jax.vjp(lambda w, s: interval(w, t, s, z), weights, state)
            by_weights, costate = pull((carry[0], jnp.full(costs.shape[1], 1.0 / costs.size)))
            return (costate, jax.tree.map(jnp.add, carry[1], by_weights)), None

        first = jnp.zeros_like(initial), jax.tree.map(jnp.zeros_like, weights)
        starts = jnp.concatenate([initial[None], ends[:-1]])
        return jax.lax.scan(body, first, (times, exogenous, starts), reverse=True)[0][1]

    def calls(scenario):
        exogenous = jnp.asarray(scenario.exogenous.permute(1, 2, 0).numpy())
        given = jnp.asarray(scenario.initial_state.T.numpy()), dt * jnp.arange(len(exogenous)), exogenous
        weights = [jnp.asarray(w.detach().numpy()) for w in torch_weights]

        def gradient():
            parts = jax.block_until_ready(gradient_of(weights, *given))
            return torch.from_numpy(np.concatenate([np.asarray(part).ravel() for part in parts]))

        return Calls(lambda: float(cost_of(weights, *given)), gradient)

    return calls


def jax_policy(system: System, weights, x):
    """The policy, affine or a perceptron, and its saturation."""
    low, high = (system.policy.clip.get_buffer(end).numpy()[:, None] for end in ("low", "high"))
    for k in range(0, len(weights), 2):
        x = weights[k] @ (jnp.tanh(x) if k else x) + weights[k + 1][:, None]
    return 0.5 * (jnp.tanh(x) + 1.0) * (high - low) + low


def jax_field(system: System, t, state, action, z):
    """The drone's equations, all strips at once."""
    radius, strip_mass = system.plant.radius.numpy(), system.plant.strip_mass.numpy()

    def total(force):
        # The strips come last: with them first, the same loops take up to 2.6 times as long.
        return (part.sum(-1) for part in force(radius, strip_mass, lambda x: x[:, None]))

    return jnp.stack(drone_rates(jnp, system, t, state, action, z, total))


def drone_rates(m, system: System, t, state, action, z, total):
    """The drone's equations by the functions of ``m``, where ``total`` sums what a function gives of the strips."""
    plant = system.plant
    a, b, c = system.closure.log_coefficients.detach().exp().tolist()
    mass, weight = float(plant.mass), float(plant.weight[1])
    rate, epsilon = 2.0 * math.pi * plant.frequency, plant.smallest_airspeed**2
    v_x, v_z = state[2] + z[0], state[3]
    A_phi, beta_w = action[0] * (math.pi / 180.0), action[1] * (math.pi / 180.0)
    sine, cosine = m.sin(rate * t), m.cos(rate * t)
    cos_phi, phi_dot = m.cos(A_phi * cosine), -rate * A_phi * sine
    sin_beta, cos_beta = m.sin(beta_w), m.cos(beta_w)
    stroke_x, stroke_z = cos_beta * v_x + sin_beta * v_z, cos_beta * v_z - sin_beta * v_x
    sin_alpha, cos_alpha = (f(math.radians(plant.pitching_amplitude) * sine) for f in (m.sin, m.cos))

    def force(r, strip_mass, wide):
        U_x, U_z = wide(cos_phi * stroke_x) - wide(phi_dot) * r, wide(stroke_z)
        U_xi, U_zeta = cos_alpha * U_x - sin_alpha * U_z, sin_alpha * U_x + cos_alpha * U_z
        speed = m.sqrt(U_x**2 + U_z**2 + epsilon)
        C_L, C_D = 2.0 * a * (U_xi / speed) * (U_zeta / speed), b + 2.0 * c * (U_xi / speed) ** 2
        pressure = strip_mass * speed
        return -pressure * (C_D * U_x + C_L * U_z), pressure * (C_L * U_x - C_D * U_z)

    F_x, F_z = total(force)
    drag = 0.5 * plant.air_density * plant.body_drag_area * m.sqrt(v_x**2 + v_z**2 + epsilon)
    force_x = cos_beta * cos_phi * F_x - sin_beta * F_z - drag * v_x
    force_z = sin_beta * cos_phi * F_x + cos_beta * F_z - drag * v_z
    return state[2], state[3], force_x / mass, (force_z + weight) / mass


def rk4_step(field, t, state, dt):
    """One step of Kutta's 3/8 rule, in JAX and in CasADi."""
    third = dt / 3.0
    k1 = field(t, state)
    k2 = field(t + third, state + third * k1)
    k3 = field(t + 2.0 * third, state + dt * k2 - third * k1)
    k4 = field(t + dt, state + dt * (k1 - k2 + k3))
    return state + (k1 + 3.0 * (k2 + k3) + k4) * (dt / 8.0)


NUMBERS = {
    1: """
using number = double;
static inline number load(const double* x) { return *x; }
static inline void store(number y, double* x) { *x = y; }
""",
    8: """
#include <experimental/simd>
using number = std::experimental::fixed_size_simd<double, 8>;
#define casadi_real number
static inline number load(const double* x) { return number(x, std::experimental::element_aligned); }
static inline void store(number y, double* x) { y.copy_to(x, std::experimental::element_aligned); }
""",
}
"""The type of number in CasADi's code: one realisation, or a vector over realisations."""
LOOPS = """
extern "C" void forward(int n, int batch, double dt, const double* z, const double* w, double* states, double* costs) {
  number weights[W];
  for (int i = 0; i < W; ++i) weights[i] = w[i];
  for (int b = 0; b < batch; b += LANES) {
    number state[S], input[Z], out[S], cost, sum = 0.0;
    for (int i = 0; i < S; ++i) state[i] = load(states + (size_t)i*batch + b);
    for (int k = 0; k < n; ++k) {
      const number t = k*dt;
      for (int i = 0; i < Z; ++i) input[i] = load(z + ((size_t)k*Z + i)*batch + b);
      const number* arg[] = {&t, state, input, weights};
      number* res[] = {out, &cost};
      interval(arg, res, 0, 0, 0);
      for (int i = 0; i < S; ++i) store(state[i] = out[i], states + ((size_t)(k + 1)*S + i)*batch + b);
      sum += cost;
    }
    store(sum, costs + b);
  }
}
extern "C" void backward(int n, int batch, double dt, const double* z, const double* w, const double* states,
                         const double* share, double* gradients) {
  static number weights[W], part[W], gradient[W];
  for (int i = 0; i < W; ++i) weights[i] = w[i];
  for (int b = 0; b < batch; b += LANES) {
    number state[S], input[Z], costate[S], before[S];
    const number shares = load(share + b);
    for (int i = 0; i < S; ++i) costate[i] = 0.0;
    for (int i = 0; i < W; ++i) gradient[i] = 0.0;
    for (int k = n - 1; k >= 0; --k) {
      const number t = k*dt;
      for (int i = 0; i < Z; ++i) input[i] = load(z + ((size_t)k*Z + i)*batch + b);
      for (int i = 0; i < S; ++i) state[i] = load(states + ((size_t)k*S + i)*batch + b);
      const number* arg[] = {&t, state, input, weights, costate, &shares};
      number* res[] = {before, part};
      interval_vjp(arg, res, 0, 0, 0);
      for (int i = 0; i < S; ++i) costate[i] = before[i];
      for (int i = 0; i < W; ++i) gradient[i] += part[i];
    }
    for (int i = 0; i < W; ++i) store(gradient[i], gradients + (size_t)i*batch + b);
  }
}
"""


def casadi_drone(system: System, lanes: int = 1):
    """Cost and gradient in C that g++ compiles, of this many realisations at once."""
    plant, weights = system.plant, list(system.policy.parameters())
    n_s, n_z, n_w = len(plant.states), len(plant.inputs), sum(w.numel() for w in weights)
    library = compiled(*casadi_interval(system), f"#define S {n_s}\n#define Z {n_z}\n#define W {n_w}\n", lanes)

    def calls(scenario):
        batch, n = scenario.exogenous.shape[:2]
        rows = torch.arange(batch + -batch % lanes) % batch  # filled up with copies to whole vectors
        z, first = scenario.exogenous[rows].permute(1, 2, 0).numpy().copy(), scenario.initial_state[rows].T.numpy()
        states, costs = np.empty((n + 1, n_s, len(rows))), np.empty(len(rows))
        share = np.where(np.arange(len(rows)) < batch, 1.0 / (n * batch), 0.0)
        gradients = np.empty((n_w, len(rows)))

        def called(function, *arrays):
            flat = np.concatenate([w.detach().numpy().ravel() for w in weights])
            pointers = (ctypes.c_void_p(x.ctypes.data) for x in (z, flat, *arrays))
            function(n, len(rows), ctypes.c_double(plant.dt), *pointers)

        def forward():
            states[0] = first
            called(library.forward, states, costs)
            return costs[:batch].mean() / n

        def gradient():
            forward()
            called(library.backward, states, share, gradients)
            return torch.from_numpy(gradients.sum(1))

        return Calls(forward, gradient)

    return calls


def compiled(interval, vjp, sizes: str, lanes: int) -> ctypes.CDLL:
    """The loops around the code of one interval, as a shared library."""
    with tempfile.TemporaryDirectory() as folder:
        generator = ca.CodeGenerator("interval.c", {"with_header": False})
        generator.add(interval)
        generator.add(vjp)
        generator.generate(f"{folder}/")
        code = Path(folder, "interval.c").read_text(encoding="utf-8")
        # All functions become static: gcc inlines none that it has to export.
        code = code.replace("\ncasadi_real casadi_sq", "\nstatic casadi_real casadi_sq")
        start = f"#include <cmath>\n#include <cstddef>\n#define CASADI_SYMBOL_EXPORT static\n#define LANES {lanes}\n"
        source, library = Path(folder, "loops.cpp"), Path(folder, "loops.so")
        source.write_text(start + sizes + NUMBERS[lanes] + code + LOOPS, encoding="utf-8")
        command = ["g++", "-std=c++17", "-O3", "-march=native", "-shared", "-fPIC", "-o", str(library), str(source)]
        subprocess.run(command, check=True, capture_output=True)
        return ctypes.CDLL(str(library))


def casadi_interval(system: System) -> tuple[ca.Function, ca.Function]:
    """One interval, (t, s, z, w) to the end state and the running cost, and its vector-Jacobian product by s and w."""
    plant, policy = system.plant, system.policy
    shapes = [tuple(w.shape) for w in policy.parameters()]
    ends = np.cumsum([0, *(math.prod(shape) for shape in shapes)]).tolist()
    t, state, z, weights = (ca.SX.sym(name, n) for name, n in zip("tszw", (1, 4, 2, ends[-1]), strict=True))
    error = plant.target.numpy() - state[:2]
    x = ca.vertcat(error, -state[2:]) / np.array([measurement.scale for measurement in plant.observed])
    for k, (part, shape) in enumerate(zip(ca.vertsplit(weights, ends), shapes, strict=True)):
        if len(shape) == 1:
            x = x + part
            continue
        x = ca.reshape(part, shape[1], shape[0]).T @ (ca.tanh(x) if k else x)  # a matrix, row by row
    low, high = (policy.clip.get_buffer(end).numpy() for end in ("low", "high"))
    action = 0.5 * (ca.tanh(x) + 1.0) * (high - low) + low
    end = rk4_step(lambda t, s: casadi_field(system, t, s, action, z), t, state, plant.dt)
    window = ca.exp(-0.5 * (error / WINDOW_WIDTH) ** 2)
    cost = 0.5 * (ca.sumsqr(error) + ca.sumsqr(state[2:] * window))
    costate, share = ca.SX.sym("l", 4), ca.SX.sym("share")
    products = ca.jtimes(ca.vertcat(end, cost), ca.vertcat(state, weights), ca.vertcat(costate, share), True)
    step = ca.Function("interval", [t, state, z, weights], ca.cse([end, cost]))
    by_state, by_weights = products[:4], products[4:]
    back = ca.Function("interval_vjp", [t, state, z, weights, costate, share], ca.cse([by_state, by_weights]))
    return step, back


def casadi_field(system: System, t, state, action, z):
    """The drone's equations, strip by strip."""
    strips = [*zip(system.plant.radius.tolist(), system.plant.strip_mass.tolist(), strict=True)]

    def total(force):
        return map(sum, zip(*(force(r, mass, lambda x: x) for r, mass in strips), strict=True))

    return ca.vertcat(*drone_rates(ca, system, t, state, action, z, total))


PEERS = {
    "jax": jax_drone,
    "casadi": casadi_drone,
    "casadi_lanes": lambda system: casadi_drone(system, lanes=8),
}


def drone_alone(config: Config) -> None:
    if config.plants != ("flapping_wing",):
        raise ValueError(f"plants={config.plants} must be flapping_wing, which alone is written in JAX and CasADi.")
    main(config, PEERS)


if __name__ == "__main__":
    main_of(Config, drone_alone)
