"""Pieces of user code as intervals: what the tracer takes, and what it refuses by a word of the message."""

import numpy as np
import torch
from torch import nn
from torch.nn import functional as FF
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


ext = torch.ones(3, requires_grad=True, **D)


def out_arg(m, s, d):
    b = torch.zeros_like(s)
    torch.add(s, d.exogenous, out=b)
    return b * m.w0


def inplace_add(m, s, d):
    y = s.clone()
    y[..., [0, 2]] = s[..., [1, 0]] * m.w0
    y[..., 1] += 2
    y.mul_(s)
    y[..., 0:2].clamp_(-0.5, 0.5)
    return y


def maskput(m, s, d):
    y = s.clone()
    y[y > 0] = 0.0
    return y * m.w0


def intview(m, s, d):
    return s.view(torch.int64).double() * 1e-19 * m.w0


def equal_(m, s, d):
    return s if torch.equal(torch.zeros(1, 3, **D), s) else s * m.w0


def long_row(known):
    """A row that is long enough for a loop, of which the first element is a known number."""

    def found(m, s, d):
        rest = torch.cat([s * k for k in range(1, 10)], -1)
        row = torch.cat([torch.full_like(s[..., :1], known), rest], -1)
        return ((row / 4.0) * m.w0 + (row * 4.0).sin()).unflatten(-1, (7, 4)).sum(-2)[..., :3]

    return found


def _pivoted(m, s, d):
    """A matrix with zeros on its diagonal, which needs pivots."""
    x = torch.nn.functional.pad(s, (0, 3), value=0.7)
    A = torch.diag_embed(x).roll(2, -1) + 0.1 * m.A * x.unsqueeze(-1)
    return torch.linalg.solve(A, x)[..., :3] * m.w0


def _double_pendulum(m, s, d):
    """M⁻¹f of two links."""
    c = 0.5 * torch.cos(s[..., 0] - s[..., 1])
    M = torch.stack([torch.stack([1.0 + m.w0.expand_as(c), c], -1), torch.stack([c, torch.ones_like(c)], -1)], -2)
    a = torch.linalg.solve(M, s[..., 1:].sin().unsqueeze(-1)).squeeze(-1)
    return torch.cat([a, s[..., :1] * torch.linalg.inv(M)[..., 0, :1]], -1)


def _assigned(m, s, d):
    rows = torch.arange(len(s)).unsqueeze(-1)
    return m.table.expand(len(s), 4).index_put((rows, (s > 0).long() + torch.arange(3) // 2), s)[..., :3] * m.w0


def _sparse(m, s, d):
    return torch.sparse.mm(m.sparse, s.t()).t() * m.w0


class WithBuffers(F):
    """A snippet with buffers: tables, a matrix and a sparse matrix."""

    def __init__(self, f, **weights):
        super().__init__(f, **weights)
        self.register_buffer("knots", knots.clone())
        self.register_buffer("table", knots.outer(knots.sin()))
        self.register_buffer("matrix", torch.tensor([[0.0, 2.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 3.0]], **D))
        self.register_buffer("sparse", torch.eye(3, **D).to_sparse(), persistent=False)
        self.plain = torch.tensor(2.0, **D)


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
CASES |= {
    "long row after 0": F(long_row(0.0)),
    "long row after 1": F(long_row(1.0)),
    "out=": F(out_arg),
    "fancy inplace": F(inplace_add),
    "mask put": F(maskput),
    "int view": F(intview),
    "equal": F(equal_),
    "gather list": F(lambda m, s, d: s[:, [0, 2, 0]] * m.w0),
    "index_select": F(lambda m, s, d: s.index_select(-1, torch.tensor([2, 2, 1])) * m.w0),
    "gather": F(lambda m, s, d: s.gather(-1, torch.tensor([[2, 2, 1]]).expand(s.shape[0], 3)) * m.w0),
    "take_along": F(lambda m, s, d: torch.take_along_dim(s, torch.tensor([[2, 2, 1]]), -1) * m.w0),
    "max dim": F(lambda m, s, d: s.max(-1, keepdim=True).values * m.w0 * s),
    "min dim": F(lambda m, s, d: s.min(-1, keepdim=True)[0] * m.w0 * s),
    "round decimals": F(lambda m, s, d: s.round(decimals=1) * m.w0),
    "bitwise int": F(lambda m, s, d: ((s * 10).long() & 3).double() * m.w0),
    "int //": F(lambda m, s, d: ((s * 10).long() // 3).double() * m.w0),
    "int %": F(lambda m, s, d: ((s * 10).long() % 3).double() * m.w0),
    "div floor": F(lambda m, s, d: torch.div(s, 0.3, rounding_mode="floor") * m.w0 * s),
    "div trunc": F(lambda m, s, d: torch.div(s, 0.3, rounding_mode="trunc") * m.w0 * s),
    "fmod": F(lambda m, s, d: torch.fmod(s, 0.3) * m.w0),
    "frac": F(lambda m, s, d: s.frac() * m.w0),
    "copysign": F(lambda m, s, d: torch.copysign(m.w0.expand(3), s)),
    "fmin/fmax": F(lambda m, s, d: torch.fmax(s, torch.fmin(s.flip(-1), m.w0))),
    "nan_to_num": F(lambda m, s, d: torch.nan_to_num(s.log()) * m.w0),
    "lookup by weight": F(lambda m, s, d: knots[torch.bucketize(m.w0.detach(), knots)] * s * m.w0),
    "negative index": F(lambda m, s, d: knots[(s > 0).long() - 1] * s * m.w0),
    "lookup 2d": F(lambda m, s, d: (knots.outer(knots))[(s > 0).long(), (s > 1).long() + 1] * s * m.w0),
    "addcmul": F(lambda m, s, d: torch.addcmul(s, s, m.w0, value=2.0)),
    "addcdiv": F(lambda m, s, d: torch.addcdiv(s, m.w0, s, value=2.0)),
    "addmm alpha": F(
        lambda m, s, d: torch.addmm(m.b, s, m.A, alpha=0.5, beta=2.0), A=torch.randn(3, 3, **D), b=torch.randn(3, **D)
    ),
    "rsub alpha": F(lambda m, s, d: torch.rsub(s, m.w0, alpha=3)),
    "sub alpha": F(lambda m, s, d: torch.sub(s, m.w0, alpha=3)),
    "add alpha": F(lambda m, s, d: torch.add(s, m.w0, alpha=3)),
    "logaddexp": F(lambda m, s, d: torch.logaddexp(s, m.w0)),
    "xlogy": F(lambda m, s, d: torch.xlogy(s, m.w0.abs() + 1)),
    "logit": F(lambda m, s, d: torch.logit(torch.sigmoid(s)) * m.w0),
    "hardtanh etc": F(
        lambda m, s, d: (
            (
                FF.hardtanh(s)
                + FF.hardsigmoid(s)
                + FF.hardswish(s)
                + FF.softsign(s)
                + FF.relu6(s)
                + FF.mish(s)
                + FF.selu(s)
                + FF.celu(s)
                + FF.logsigmoid(s)
                + FF.tanhshrink(s)
                + FF.softshrink(s, 0.1)
                + FF.hardshrink(s, 0.1)
            )
            * m.w0
        )
    ),
    "gelu tanh": F(lambda m, s, d: FF.gelu(s, approximate="tanh") * m.w0),
    "prelu": F(lambda m, s, d: FF.prelu(s, m.w0)),
    "softplus beta": F(lambda m, s, d: FF.softplus(s, beta=3.0, threshold=2.0) * m.w0),
    "var/std": F(lambda m, s, d: (s.var(-1, keepdim=True) + s.std(-1, keepdim=True)) * m.w0 * s),
    "mean": F(lambda m, s, d: s.mean(-1, keepdim=True) * m.w0 * s),
    "layernorm": F(lambda m, s, d: m.modules_[0](s) * m.w0, nn.LayerNorm(3)),
    "logcumsumexp": F(lambda m, s, d: s.logcumsumexp(-1) * m.w0),
    "cumprod": F(lambda m, s, d: s.cumprod(-1) * m.w0),
    "diff": F(lambda m, s, d: s.diff(dim=-1, prepend=s[:, :1]) * m.w0),
    "outer/kron": F(lambda m, s, d: torch.kron(s, m.w0.unsqueeze(0))),
    "tril": F(lambda m, s, d: (m.A.tril() @ s.unsqueeze(-1)).squeeze(-1), A=torch.randn(3, 3, **D)),
    "det": F(lambda m, s, d: torch.linalg.det(torch.eye(3, **D) + torch.diag_embed(s)).unsqueeze(-1) * m.w0),
    "matrix_exp": F(
        lambda m, s, d: (torch.linalg.matrix_exp(m.A) @ s.unsqueeze(-1)).squeeze(-1), A=torch.randn(3, 3, **D)
    ),
    "norms": F(
        lambda m, s, d: (
            (
                s.norm(dim=-1, keepdim=True)
                + s.norm(p=1, dim=-1, keepdim=True)
                + s.norm(p=float("inf"), dim=-1, keepdim=True)
                + s.norm(p=3, dim=-1, keepdim=True)
            )
            * m.w0
        )
    ),
    "normalize": F(lambda m, s, d: FF.normalize(s, dim=-1) * m.w0),
    "huber": F(lambda m, s, d: FF.huber_loss(s, m.w0.expand_as(s), reduction="none")),
    "cdist": F(lambda m, s, d: torch.cdist(s.unsqueeze(1), m.A).squeeze(1) * m.w0, A=torch.randn(3, 3, **D)),
    "external leaf": F(lambda m, s, d: s * ext * m.w0),
    "float32 const": F(
        lambda m, s, d: s * torch.tensor(0.1, dtype=torch.float32) * torch.tensor(0.3, dtype=torch.float32) * m.w0
    ),
    "float32 table": F(lambda m, s, d: s * torch.linspace(0, 1, 3, dtype=torch.float32).sin() * m.w0),
    "np.asarray": F(lambda m, s, d: s * m.w0 + float(np.asarray(s.detach())[0, 0])),
    "tolist": F(lambda m, s, d: s * s.detach().tolist()[0][0]),
    "batch mean": F(lambda m, s, d: s.mean(0, keepdim=True) * m.w0 + s),
    "batch size": F(lambda m, s, d: s * m.w0 * s.shape[0]),
    "pow": F(
        lambda m, s, d: (
            (
                s**2
                + s**3
                + s**-1
                + s**-2
                + s.abs() ** 0.5
                + s.abs() ** -0.5
                + s**0
                + s**7
                + s**11
                + 2.0**s
                + s.abs() ** 2.5
            )
            * m.w0
        )
    ),
    "rnncell": F(lambda m, s, d: m.modules_[0](s, s), nn.RNNCell(3, 3)),
    "lstmcell": F(lambda m, s, d: m.modules_[0](s, (s, s))[0], nn.LSTMCell(3, 3)),
    "mha": F(
        lambda m, s, d: m.modules_[0](s.unsqueeze(1), s.unsqueeze(1), s.unsqueeze(1))[0].squeeze(1),
        nn.MultiheadAttention(3, 1, batch_first=True),
    ),
    "conv1d": F(lambda m, s, d: m.modules_[0](s.unsqueeze(1)).squeeze(1), nn.Conv1d(1, 1, 3, padding=1)),
    "bilinear": F(lambda m, s, d: m.modules_[0](s, s), nn.Bilinear(3, 3, 3)),
    "batchnorm eval": F(lambda m, s, d: m.modules_[0](s), nn.BatchNorm1d(3).eval()),
    "dropout eval": F(lambda m, s, d: m.modules_[0](s) * m.w0, nn.Dropout().eval()),
    "embedding const": F(lambda m, s, d: m.modules_[0](torch.tensor([0, 1, 2])).sum(-1) * s, nn.Embedding(3, 2)),
    "spectral param": F(lambda m, s, d: m.modules_[0](s), torch.nn.utils.parametrizations.weight_norm(nn.Linear(3, 3))),
    "complex abs": F(lambda m, s, d: torch.view_as_complex(s[..., :2].contiguous()).abs().unsqueeze(-1) * m.w0),
    "erfinv": F(lambda m, s, d: torch.erfinv(s.tanh()) * m.w0),
    "special": F(
        lambda m, s, d: (
            (
                torch.special.expit(s)
                + torch.sinc(s)
                + torch.erfc(s)
                + torch.special.ndtr(s)
                + torch.exp2(s)
                + torch.expm1(s)
            )
            * m.w0
        )
    ),
    "sign": F(lambda m, s, d: s.sign() * m.w0),
    "angle": F(lambda m, s, d: torch.deg2rad(s) * torch.rad2deg(m.w0)),
    "checkpoint": F(
        lambda m, s, d: torch.utils.checkpoint.checkpoint(lambda x: x.sin() * m.w0, s, use_reentrant=False)
    ),
    "detach": F(lambda m, s, d: s.detach() * m.w0 + s),
    "no_grad": F(lambda m, s, d: s * m.w0 * torch.no_grad()(torch.sin)(s)),
    "while const": F(lambda m, s, d: s * m.w0 if torch.tensor(1.0) > 0 else s),
    "isclose": F(lambda m, s, d: torch.where(torch.isclose(s, s * 1.0), s * m.w0, s)),
    "quantile/median": F(lambda m, s, d: s.median(-1, keepdim=True)[0] * m.w0),
    "topk": F(lambda m, s, d: s.topk(3, -1)[0] * m.w0),
    "any/all": F(
        lambda m, s, d: torch.where((s > 0).any(-1, keepdim=True) & (s < 2).all(-1, keepdim=True), s * m.w0, -s)
    ),
    "count": F(lambda m, s, d: (s > 0).sum(-1, keepdim=True) * m.w0 * s),
    "bool arith": F(lambda m, s, d: (s > 0) * s * m.w0 + (s < 0).double()),
    "not": F(lambda m, s, d: torch.where(~(s > 0) ^ (s < 1), s * m.w0, s)),
    "meshgrid": F(lambda m, s, d: torch.stack(torch.meshgrid(s[0], s[0], indexing="ij")).sum((0, 1))[None] * m.w0),
    "tensordot": F(lambda m, s, d: torch.tensordot(s, m.A, dims=1), A=torch.randn(3, 3, **D)),
    "pad": F(lambda m, s, d: FF.pad(s, (1, 1))[..., 1:4] * m.w0),
    "pad replicate": F(lambda m, s, d: FF.pad(s.unsqueeze(1), (1, 1), mode="replicate").squeeze(1)[..., :3] * m.w0),
    "interp grid": F(lambda m, s, d: FF.interpolate(s.unsqueeze(1), size=3, mode="linear").squeeze(1) * m.w0),
    "unfold": F(lambda m, s, d: s.unfold(-1, 2, 1).sum(-1).repeat(1, 2)[..., :3] * m.w0),
    "set to scalar": F(lambda m, s, d: torch.full_like(s, 2.0) * m.w0 + s.new_tensor([1.0, 2.0, 3.0])),
    "split/chunk": F(lambda m, s, d: torch.cat([x * m.w0 for x in s.split(1, -1)][::-1], -1)),
    "wide pow": F(lambda m, s, d: (m.modules_[0](s) ** 2).tanh() @ m.A, nn.Linear(3, 40), A=torch.randn(40, 3, **D)),
    "wide misc": F(
        lambda m, s, d: (
            (
                torch.where(m.modules_[0](s) > 0, m.modules_[0](s), m.modules_[0](s) * 0.1).clamp(-1, 1).abs()
                + FF.gelu(m.modules_[0](s))
            ).softmax(-1)
            @ m.A
        ),
        nn.Linear(3, 40),
        A=torch.randn(40, 3, **D),
    ),
}
CASES |= {
    "solve 6x6 with pivots": F(_pivoted, A=torch.randn(6, 6, **D)),
    "solve 7x7": F(lambda m, s, d: torch.linalg.solve(m.A, m.A[0])[:3] * s, A=torch.randn(7, 7, **D)),
    "solve from the right": F(
        lambda m, s, d: torch.linalg.solve(m.A + torch.diag_embed(s), s.unsqueeze(-2), left=False).squeeze(-2),
        A=torch.randn(3, 3, **D),
    ),
    "solve, several right sides": F(
        lambda m, s, d: torch.linalg.solve(m.A, torch.stack([s, s.sin()], -1)).sum(-1), A=torch.randn(3, 3, **D)
    ),
    "inverse that is learned": F(lambda m, s, d: s @ torch.linalg.inv(m.A), A=torch.randn(3, 3, **D)),
    "inverse of a buffer": WithBuffers(lambda m, s, d: s @ torch.linalg.inv(m.matrix) * m.w0),
    "double pendulum": F(_double_pendulum),
    "diag_embed": F(lambda m, s, d: (torch.diag_embed(s[..., :2], offset=1) @ s.unsqueeze(-1)).squeeze(-1) * m.w0),
    "table in a buffer": WithBuffers(lambda m, s, d: m.table[torch.bucketize(s, m.knots) - 1, 3] * m.w0),
    "table of a buffer's numbers": WithBuffers(
        lambda m, s, d: (m.table.exp() * m.w0)[(s > 0).long(), torch.bucketize(s, m.knots).clamp(0, 19)]
    ),
    "table of states": F(lambda m, s, d: s[torch.arange(len(s)).unsqueeze(-1), (s > 0).long()] * m.w0),
    "column of a table": WithBuffers(lambda m, s, d: m.table[:, 2][torch.bucketize(s, m.knots) - 1] * m.w0),
    "learned table, assigned": F(_assigned, table=torch.randn(4, **D)),
    "scaled dot product": F(
        lambda m, s, d: FF.scaled_dot_product_attention(*(s.reshape(-1, 1, 3, 1) * m.w0 for _ in range(3))).flatten(1)
    ),
    "number of a buffer": WithBuffers(lambda m, s, d: s * m.knots[3].item() * m.w0),
    "branch on a buffer": WithBuffers(lambda m, s, d: s * m.w0 if m.knots[3] > 0 else -s),
    "number of a plain tensor": WithBuffers(lambda m, s, d: s * m.plain.item() * m.w0 if m.plain > 0 else -s),
    "sparse buffer": WithBuffers(_sparse),
    "wide relu and max": F(
        lambda m, s, d: torch.maximum(m.modules_[0](s), 0.1 * m.modules_[1](s)).relu() @ m.A,
        nn.Linear(3, 40),
        nn.Linear(3, 40),
        A=torch.randn(40, 3, **D),
    ),
    "wide masks": F(
        lambda m, s, d: ((m.modules_[0](s) > 0.0) & ~(m.modules_[0](s) > 1.0)).double() @ m.A * m.w0,
        nn.Linear(3, 40),
        A=torch.randn(40, 3, **D),
    ),
}
REFUSED = {
    "dropout in training": "random",
    "func.jvp inside": "_has_same_storage_numel",
    "float32 inside": "float32",
    "complex inside": "complex",
    "lgamma": "lgamma",
    "sort": "sort",
    "argmax one-hot": "argmax",
    "random": "random",
    "branch on a state": "branch",
    "branch on t": "branch",
    ".item()": "number",
    ".numpy()": "numpy",
    "torch.cond": "cond",
    "out=": "out",
    "int view": "another type",
    "equal": "branch",
    "round decimals": "decimals",
    "bitwise int": "bits",
    "copysign": "signbit",
    "addmm alpha": "alpha",
    "hardtanh etc": "hardshrink_backward",
    "logcumsumexp": "logcumsumexp",
    "det": "_linalg_det",
    "matrix_exp": "linalg_matrix_exp",
    "cdist": "_cdist",
    "external leaf": "no parameter",
    "np.asarray": "__array__",
    "tolist": "tolist",
    "conv1d": "convolution",
    "bilinear": "_trilinear",
    "spectral param": "_weight_norm",
    "complex abs": "another type",
    "erfinv": "erf_inv",
    "checkpoint": "no parameter",
    "quantile/median": "median",
    "topk": "topk",
    "pad replicate": "replication_pad1d_backward",
    "interp grid": "upsample_linear1d_backward",
    "solve 7x7": "7 unknowns, more than 6",
    "number of a buffer": "number",
    "branch on a buffer": "branch",
    "sparse buffer": "sparse",
}
"""Code that is refused, with a word of the message."""
MIXED = ("batch mean", "batch size", "meshgrid")
"""Code in which a realisation depends on the others; it differs from torch, which the comparison finds."""
