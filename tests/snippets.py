"""Pieces of user code as intervals: what the tracer takes, and what it refuses."""

import torch
from torch import nn
from traced_function import Snippet as F

D = {"dtype": torch.float64}
torch.manual_seed(0)


def newton(m, s, d):
    x = s.clone()
    for _ in range(5):
        x = x - (x**3 + x - s * m.w0) / (3 * x**2 + 1)
    return x


def inplace(m, s, d):
    y = torch.zeros_like(s)
    y[..., 0] = s[..., 1] * m.w0
    y[..., 1:] = torch.sin(s[..., 1:])
    y += 0.5 * s
    return y


def branch(m, s, d):
    return s * m.w0 if s.sum() > 0 else -s


def branch_t(m, s, d):
    return s * m.w0 if float(d.t) > 0.5 else -s


def item(m, s, d):
    return s * s[0, 0].item()


def numpy_(m, s, d):
    return s * m.w0 + float(s.detach().numpy()[0, 0])


class Swish(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return x * torch.sigmoid(x)

    @staticmethod
    def backward(ctx, g):
        (x,) = ctx.saved_tensors
        y = torch.sigmoid(x)
        return g * (y + x * y * (1 - y))


knots = torch.linspace(-3, 3, 20, **D)
EYE = torch.eye(3, **D)


def table_linear(m, s, d):
    i = torch.searchsorted(knots, s).clamp(1, 19)
    x0, x1 = knots[i - 1], knots[i]
    y = m.table
    return y[i - 1] + (y[i] - y[i - 1]) * (s - x0) / (x1 - x0)


def jac_inside(m, s, d):
    return torch.func.jvp(lambda x: torch.sin(x) * m.w0, (s,), (torch.ones_like(s),))[1]


def vmap_inside(m, s, d):
    return torch.func.vmap(lambda x: torch.cos(x * m.w0))(s)


def grad_inside(m, s, d):
    return torch.func.grad(lambda x: (torch.cos(x) * m.w0).sum())(s)


def attention(m, s, d):
    q = s.unsqueeze(-1) * m.q
    k = s.unsqueeze(-1) * m.k
    a = torch.softmax(q @ k.transpose(-1, -2), -1)
    return (a @ s.unsqueeze(-1)).squeeze(-1)


def cond_hop(m, s, d):
    return torch.cond(s.sum() > 0, lambda x: x.sin(), lambda x: x.cos(), (s,))


CASES = {
    "newton 5 iterations": F(newton),
    "in-place writes": F(inplace),
    "einsum": F(lambda m, s, d: torch.einsum("bi,ij->bj", s, m.A), A=torch.randn(3, 3, **D)),
    "matmul @ with matrix of states": F(
        lambda m, s, d: (s.unsqueeze(-1) * s.unsqueeze(-2) @ s.unsqueeze(-1)).squeeze(-1) * m.w0
    ),
    "linalg.cross": F(lambda m, s, d: torch.linalg.cross(s, m.a.expand_as(s)), a=torch.randn(3, **D)),
    "norm": F(lambda m, s, d: s / torch.linalg.vector_norm(s, dim=-1, keepdim=True) * m.w0),
    "linalg.solve 3x3": F(lambda m, s, d: torch.linalg.solve(EYE + 0.1 * torch.diag_embed(s), s * m.w0)),
    "linalg.inv": F(lambda m, s, d: (torch.linalg.inv(EYE * 2 + torch.diag_embed(s)) @ s.unsqueeze(-1)).squeeze(-1)),
    "cumsum": F(lambda m, s, d: s.cumsum(-1) * m.w0),
    "prod": F(lambda m, s, d: s.prod(-1, keepdim=True) * m.w0 * s),
    "max over dim": F(lambda m, s, d: s.amax(-1, keepdim=True) * m.w0),
    "logsumexp": F(lambda m, s, d: s.logsumexp(-1, keepdim=True) * m.w0),
    "softmax": F(lambda m, s, d: s.softmax(-1) * m.w0),
    "attention": F(attention, q=torch.randn(4, **D), k=torch.randn(4, **D)),
    "roll/flip": F(lambda m, s, d: s.roll(1, -1) * m.w0 - s.flip(-1)),
    "mlp silu": F(lambda m, s, d: m.modules_[0](s), nn.Sequential(nn.Linear(3, 64), nn.SiLU(), nn.Linear(64, 3))),
    "mlp gelu": F(lambda m, s, d: m.modules_[0](s), nn.Sequential(nn.Linear(3, 40), nn.GELU(), nn.Linear(40, 3))),
    "mlp relu": F(lambda m, s, d: m.modules_[0](s), nn.Sequential(nn.Linear(3, 40), nn.ReLU(), nn.Linear(40, 3))),
    "mlp elu": F(lambda m, s, d: m.modules_[0](s), nn.Sequential(nn.Linear(3, 40), nn.ELU(), nn.Linear(40, 3))),
    "mlp softplus": F(
        lambda m, s, d: m.modules_[0](s), nn.Sequential(nn.Linear(3, 40), nn.Softplus(), nn.Linear(40, 3))
    ),
    "mlp leaky": F(lambda m, s, d: m.modules_[0](s), nn.Sequential(nn.Linear(3, 40), nn.LeakyReLU(), nn.Linear(40, 3))),
    "mlp layernorm tanh": F(
        lambda m, s, d: m.modules_[0](s), nn.Sequential(nn.Linear(3, 40), nn.LayerNorm(40), nn.Tanh(), nn.Linear(40, 3))
    ),
    "mlp sigmoid 64x64": F(
        lambda m, s, d: m.modules_[0](s),
        nn.Sequential(nn.Linear(3, 64), nn.Sigmoid(), nn.Linear(64, 64), nn.Sigmoid(), nn.Linear(64, 3)),
    ),
    "dropout in training": F(
        lambda m, s, d: m.modules_[0](s), nn.Sequential(nn.Linear(3, 40), nn.Dropout(0.5), nn.Linear(40, 3))
    ),
    "GRUCell": F(lambda m, s, d: m.modules_[0](s, s), nn.GRUCell(3, 3)),
    "custom autograd.Function": F(lambda m, s, d: Swish.apply(s * m.w0)),
    "table of constants, linear": F(lambda m, s, d: table_linear(type("o", (), {"table": knots.sin()}), s, d) * m.w0),
    "learned table, look-up": F(table_linear, table=knots.sin()),
    "func.jvp inside": F(jac_inside),
    "func.vmap inside": F(vmap_inside),
    "func.grad inside": F(grad_inside),
    "float32 inside": F(lambda m, s, d: (s.float() * 2).double() * m.w0),
    "complex inside": F(lambda m, s, d: (torch.exp(1j * s)).real * m.w0),
    "trig, atan2, hypot": F(lambda m, s, d: torch.atan2(s, torch.hypot(s, d.exogenous) + m.w0)),
    "pow fractional, erf, lgamma": F(lambda m, s, d: torch.erf(s) + (s.abs() + 1) ** m.w0),
    "lgamma": F(lambda m, s, d: torch.lgamma(s.abs() + 1) * m.w0),
    "where on t": F(lambda m, s, d: torch.where(d.t.unsqueeze(-1) > 0.5, s * m.w0, -s)),
    "remainder, floor": F(lambda m, s, d: torch.remainder(s, 0.7) * m.w0 + torch.floor(s)),
    "sort": F(lambda m, s, d: s.sort(-1).values * m.w0),
    "argmax one-hot": F(lambda m, s, d: torch.nn.functional.one_hot(s.argmax(-1), 3) * m.w0),
    "scatter": F(
        lambda m, s, d: torch.zeros_like(s).scatter(-1, torch.tensor([[2, 0, 1]]).expand(s.shape[0], 3), s) * m.w0
    ),
    "interpolate clamp lerp": F(lambda m, s, d: torch.lerp(s, s.clamp(-0.5, 0.5), m.w0)),
    "random": F(lambda m, s, d: s * m.w0 + torch.randn_like(s)),
    "branch on a state": F(branch),
    "branch on t": F(branch_t),
    ".item()": F(item),
    ".numpy()": F(numpy_),
    "torch.cond": F(cond_hop),
}
