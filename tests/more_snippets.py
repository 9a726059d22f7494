"""More pieces of user code as intervals: right, refused by a word of the message, or no function of the arguments."""

import copy
import io
import math
import pickle
import random
import time

import numpy as np
import torch
from snippets import D, WithBuffers, knots
from torch import nn
from torch.nn import functional as FF
from torch.nn.utils import parametrizations
from traced_function import Snippet as F

torch.manual_seed(1)
A33, A3, EYE = torch.randn(3, 3, **D), torch.randn(3, **D), torch.eye(3, **D)
HALF, LOW, NODES = torch.tensor([0.5], **D), torch.zeros((), **D), np.array([1.0, 2.0, 3.0])


def of_layers(*layers):
    return F(lambda m, s, d: m.modules_[0](s), nn.Sequential(*layers))


def with_matrix(function):
    return F(function, A=A33)


def by_row(module):
    """A module on rows with one channel."""
    return F(lambda m, s, d: m.modules_[0](s.unsqueeze(1)).squeeze(1) * m.w0, module)


def by_time(module):
    """A module that reads states in turn."""
    return F(lambda m, s, d: m.modules_[0](s.unsqueeze(-1))[0][..., 0], module)


def asserted(m, s, d):
    assert s.isfinite().all()
    return s * m.w0


def until(m, s, d):
    x = s.clone()
    while (x - s * m.w0).abs().max() > 0.3:
        x = 0.5 * (x + s * m.w0)
    return x


class Half(torch.autograd.Function):
    """Rounds, and passes the gradient on."""

    @staticmethod
    def forward(ctx, x):
        return x.round()

    @staticmethod
    def backward(ctx, g):
        return g


def hooked(forward):
    layer = nn.Linear(3, 3)
    layer.register_forward_hook(lambda m, i, o: o.tanh()) if forward else layer.register_full_backward_hook(
        lambda m, i, o: None
    )
    return layer


class Symmetric(nn.Module):
    def forward(self, x):
        return x.triu() + x.triu(1).mT


def parametrised():
    layer = nn.Linear(3, 3)
    nn.utils.parametrize.register_parametrization(layer, "weight", Symmetric())
    return layer


def tied():
    a, b = nn.Linear(3, 3), nn.Linear(3, 3)
    b.weight = a.weight
    return nn.Sequential(a, nn.Tanh(), b)


def frozen():
    layer = nn.Linear(3, 3)
    layer.weight.requires_grad_(False)
    return layer


def diffusion(m, s, d):
    x = s.repeat(1, 20)
    y = FF.pad(x, (1, 1))
    return (y[..., 2:] - 2 * x + y[..., :-2]).unflatten(-1, (20, 3)).sum(-2) * m.w0


def hook_on_a_tensor(m, s, d):
    y = s * m.w0
    if y.requires_grad:
        y.register_hook(lambda g: g * 2)
    return y


def slope(m, s, d):
    x = s.detach().requires_grad_()
    with torch.enable_grad():
        return torch.autograd.grad((torch.sin(x) * m.w0).sum(), x, create_graph=True)[0]


def saved(m, s, d):
    file = io.BytesIO()
    torch.save(s.detach(), file)
    file.seek(0)
    return torch.load(file) * m.w0


def set_data(m, s, d):
    y = s.clone()
    y.data = s.detach() * 2
    return y * m.w0


class Typed(WithBuffers):
    """With buffers of other types."""

    def __init__(self, f):
        super().__init__(f)
        self.register_buffer("ints", torch.tensor([2, 0, 1]))
        self.register_buffer("flags", torch.tensor([True, False, True]))
        self.register_buffer("single", torch.tensor([1.0, 2.0, 3.0], dtype=torch.float32))


ACTIVATIONS = [
    *(nn.ReLU(), nn.LeakyReLU(), nn.ELU(), nn.SELU(), nn.CELU(), nn.GELU(), nn.GELU(approximate="tanh"), nn.SiLU()),
    *(nn.Softplus(), nn.Mish(), nn.Hardtanh(), nn.Hardswish(), nn.Softsign(), nn.Tanhshrink(), nn.PReLU(), nn.ReLU6()),
    *(nn.Softshrink(0.1), nn.Hardshrink(0.1), nn.LogSigmoid(), nn.Threshold(0.1, 0.0), nn.Softmin(-1)),
    *(nn.LogSoftmax(-1), nn.Hardsigmoid()),
]
CASES = {
    "while until converged": F(until),
    "int(t)": F(lambda m, s, d: s * m.w0 * int(d.t[0] * 3)),
    "assert": F(asserted),
    "np.sin of detached": F(lambda m, s, d: torch.as_tensor(np.sin(s.detach())) * m.w0),
    "np scalar": F(lambda m, s, d: s * np.pi * np.float64(2.0) * m.w0),
    "np scalar left": F(lambda m, s, d: np.float64(2.0) * s * m.w0),
    "np array as tensor": F(lambda m, s, d: torch.from_numpy(np.array([1.0, 2.0, 3.0])) * s * m.w0),
    "torch.tensor of states": F(lambda m, s, d: torch.tensor([s[0, 0], 1.0, 2.0]).double() * m.w0),
    "math.sin": F(lambda m, s, d: math.sin(s[0, 0]) * s * m.w0),
    "where NaN branch": F(lambda m, s, d: torch.where(s > 0, s.sqrt(), 0.0) * m.w0),
    "mask put tensor": F(lambda m, s, d: s.clone().index_put((s < 0,), LOW) * m.w0),
    "mask read": F(lambda m, s, d: s * m.w0 * s[s > 0].sum()),
    "masked_select": F(lambda m, s, d: s * m.w0 * s.masked_select(s > 0).sum()),
    "nonzero": F(lambda m, s, d: s * m.w0 * (s > 0).nonzero().shape[0]),
    "masked_fill_": F(lambda m, s, d: s.clone().masked_fill_(s > 0, 0.1) * m.w0),
    "masked_scatter": F(lambda m, s, d: s.masked_scatter(s > 0, s.abs()) * m.w0),
    "torch.take": F(lambda m, s, d: torch.take(knots, (s > 0).long() + 3) * s * m.w0),
    "int buffer index": Typed(lambda m, s, d: s[..., m.ints] * m.w0),
    "bool buffer": Typed(lambda m, s, d: s * m.flags * m.w0 + s[..., m.flags].sum(-1, keepdim=True)),
    "float32 buffer": Typed(lambda m, s, d: s * m.single.double() * m.w0),
    "float32 buffer mixed": Typed(lambda m, s, d: s * m.single * m.w0),
    "gather that varies": F(lambda m, s, d: s.gather(-1, (s > 0).long()) * m.w0),
    "index_select that varies": F(lambda m, s, d: knots.index_select(0, (s[0] > 0).long()) * s * m.w0),
    "embedding that varies": F(lambda m, s, d: m.modules_[0]((s[..., 0] > 0).long()) * s, nn.Embedding(3, 3)),
    "one_hot of a place": F(lambda m, s, d: FF.one_hot((s[..., 0] > 0).long(), 3) * s * m.w0),
    "learned table indexed": F(lambda m, s, d: m.tab[(s > 0).long()] * s, tab=torch.randn(4, **D)),
    "learned table gather": F(
        lambda m, s, d: m.tab.expand(len(s), 4).gather(-1, (s > 0).long()) * s, tab=torch.randn(4, **D)
    ),
    "cummax": F(lambda m, s, d: s.cummax(-1).values * m.w0),
    "argmin": F(lambda m, s, d: s.argmin(-1, keepdim=True) * s * m.w0),
    "argsort": F(lambda m, s, d: s.argsort(-1) * s * m.w0),
    "kthvalue": F(lambda m, s, d: s.kthvalue(2, -1, keepdim=True).values * m.w0 * s),
    "polar": F(lambda m, s, d: torch.polar(s.abs(), s).real * m.w0),
    "fft": F(lambda m, s, d: torch.fft.rfft(s).abs()[..., :1] * s * m.w0),
    "complex number": F(lambda m, s, d: (s * (1 + 2j)).imag * m.w0),
    "nn.GRU": by_time(nn.GRU(1, 2, batch_first=True)),
    "nn.LSTM": by_time(nn.LSTM(1, 2, batch_first=True)),
    "nn.RNN": by_time(nn.RNN(1, 2, batch_first=True)),
    "RMSNorm": of_layers(nn.Linear(3, 8), nn.RMSNorm(8), nn.Linear(8, 3)),
    "GroupNorm": of_layers(nn.Linear(3, 8), nn.GroupNorm(2, 8), nn.Linear(8, 3)),
    "InstanceNorm": by_row(nn.InstanceNorm1d(1)),
    "LocalResponseNorm": F(lambda m, s, d: m.modules_[0](s.unsqueeze(-1)).squeeze(-1) * m.w0, nn.LocalResponseNorm(2)),
    "BatchNorm train": of_layers(nn.Linear(3, 8), nn.BatchNorm1d(8), nn.Linear(8, 3)),
    "BatchNorm no stats": of_layers(nn.Linear(3, 8), nn.BatchNorm1d(8, track_running_stats=False), nn.Linear(8, 3)),
    "AlphaDropout": of_layers(nn.Linear(3, 8), nn.AlphaDropout(), nn.Linear(8, 3)),
    "RReLU": of_layers(nn.Linear(3, 8), nn.RReLU(), nn.Linear(8, 3)),
    "RReLU eval": F(lambda m, s, d: m.modules_[0](s) * m.w0, nn.RReLU().eval()),
    "rand": F(lambda m, s, d: s * m.w0 + torch.rand(1).double()),
    "generator inside": F(
        lambda m, s, d: s * m.w0 + torch.randn(1, generator=torch.Generator().manual_seed(0)).double()
    ),
    "bernoulli": F(lambda m, s, d: s * m.w0 * torch.bernoulli(torch.full_like(s, 0.5))),
    "numpy random": F(lambda m, s, d: s * m.w0 + float(np.random.rand())),  # noqa: NPY002
    "python random": F(lambda m, s, d: s * m.w0 + random.random()),
    "time": F(lambda m, s, d: s * m.w0 + time.time() % 1.0),
    "GLU": of_layers(nn.Linear(3, 6), nn.GLU()),
    "MaxPool1d": by_row(nn.MaxPool1d(2)),
    "AvgPool1d": by_row(nn.AvgPool1d(2)),
    "AdaptiveAvgPool1d": by_row(nn.AdaptiveAvgPool1d(1)),
    "spectral_norm train": of_layers(parametrizations.spectral_norm(nn.Linear(3, 3))),
    "spectral_norm eval": of_layers(parametrizations.spectral_norm(nn.Linear(3, 3)).eval()),
    "orthogonal": of_layers(parametrizations.orthogonal(nn.Linear(3, 3))),
    "TransformerEncoderLayer eval": by_row(nn.TransformerEncoderLayer(3, 1, 8, batch_first=True).eval()),
    "TransformerEncoderLayer dropout": by_row(nn.TransformerEncoderLayer(3, 1, 8, batch_first=True)),
    "mha weights off": F(
        lambda m, s, d: m.modules_[0](s.unsqueeze(1), s.unsqueeze(1), s.unsqueeze(1), need_weights=False)[0].squeeze(1),
        nn.MultiheadAttention(3, 3, batch_first=True),
    ),
    "mha eval": F(
        lambda m, s, d: m.modules_[0](s.unsqueeze(1), s.unsqueeze(1), s.unsqueeze(1))[0].squeeze(1),
        nn.MultiheadAttention(3, 1, batch_first=True).eval(),
    ),
    "sparse @": Typed(lambda m, s, d: (m.sparse @ s.t()).t() * m.w0),
    "cholesky": with_matrix(lambda m, s, d: torch.linalg.cholesky(EYE * 9 + 0.1 * torch.diag_embed(s)).sum(-1) * m.w0),
    "eigh": with_matrix(lambda m, s, d: torch.linalg.eigh(torch.diag_embed(s) + m.A + m.A.mT).eigenvalues),
    "svd": with_matrix(lambda m, s, d: torch.linalg.svdvals(torch.diag_embed(s) + m.A)),
    "qr": with_matrix(lambda m, s, d: torch.linalg.qr(torch.diag_embed(s) + m.A).R.sum(-1)),
    "lstsq": with_matrix(
        lambda m, s, d: torch.linalg.lstsq(torch.diag_embed(s) + m.A, s.unsqueeze(-1)).solution.squeeze(-1)
    ),
    "pinv": with_matrix(lambda m, s, d: s @ torch.linalg.pinv(m.A)),
    "solve_triangular": with_matrix(
        lambda m, s, d: torch.linalg.solve_triangular(m.A.tril() + 3 * EYE, s.unsqueeze(-1), upper=False).squeeze(-1)
    ),
    "inv const": F(lambda m, s, d: s @ torch.linalg.inv(EYE * 2) * m.w0),
    "det const": F(lambda m, s, d: s * torch.linalg.det(EYE * 2) * m.w0),
    "matrix_power": with_matrix(lambda m, s, d: s @ torch.linalg.matrix_power(m.A, 3)),
    "multi_dot": with_matrix(lambda m, s, d: torch.linalg.multi_dot([s, m.A, m.A])),
    "trace": with_matrix(lambda m, s, d: s * torch.trace(m.A)),
    "diagonal": with_matrix(lambda m, s, d: s * torch.diagonal(m.A)),
    "bessel": F(lambda m, s, d: torch.special.bessel_j0(s.detach()) * m.w0),
    "i0": F(lambda m, s, d: torch.special.i0(s) * m.w0),
    "digamma": F(lambda m, s, d: torch.digamma(s.abs() + 1) * m.w0),
    "heaviside": F(lambda m, s, d: torch.heaviside(s.detach(), HALF) * m.w0),
    "gcd": F(lambda m, s, d: torch.gcd((s * 10).long(), torch.tensor(6)) * m.w0),
    "mod": F(lambda m, s, d: (s % 0.3) * m.w0),
    "pow by tensors": F(lambda m, s, d: (s.abs() ** s) * m.w0),
    "float_power": F(lambda m, s, d: s.abs().float_power(1.5) * m.w0),
    "frexp": F(lambda m, s, d: s.frexp().mantissa * m.w0),
    "ldexp": F(lambda m, s, d: torch.ldexp(s, torch.tensor(2)) * m.w0),
    "trapezoid": F(lambda m, s, d: torch.trapezoid(s, dx=0.1, dim=-1).unsqueeze(-1) * m.w0),
    "cumulative_trapezoid": F(lambda m, s, d: FF.pad(torch.cumulative_trapezoid(s, dim=-1), (1, 0)) * m.w0),
    "gradient": F(lambda m, s, d: torch.gradient(s, dim=-1)[0] * m.w0),
    "histc": F(lambda m, s, d: torch.histc(s.detach(), 3) * m.w0),
    "bincount": F(lambda m, s, d: torch.bincount((s[0] > 0).long(), minlength=3)[:3] * m.w0),
    "unique": F(lambda m, s, d: s * torch.unique(s.detach()).numel() * m.w0),
    "repeat_interleave": F(lambda m, s, d: s.repeat_interleave(2, -1)[..., :3] * m.w0),
    "tile": F(lambda m, s, d: s.tile(1, 2)[..., :3] * m.w0),
    "rot90": F(lambda m, s, d: torch.rot90(s.unsqueeze(-1), 2, (1, 2)).squeeze(-1) * m.w0),
    "block_diag": F(lambda m, s, d: s @ torch.block_diag(m.A, m.w0.unsqueeze(0)), A=torch.randn(2, 2, **D)),
    "index_add": F(lambda m, s, d: torch.zeros_like(s).index_add(-1, torch.tensor([0, 0, 2]), s) * m.w0),
    "index_copy": F(lambda m, s, d: torch.zeros_like(s).index_copy(-1, torch.tensor([2, 0, 1]), s) * m.w0),
    "index_fill": F(lambda m, s, d: s.index_fill(-1, torch.tensor([0]), 0.1) * m.w0),
    "scatter_reduce": F(
        lambda m, s, d: (
            torch.zeros_like(s).scatter_reduce(-1, torch.tensor([[0, 0, 1]]).expand(len(s), 3), s, "sum") * m.w0
        )
    ),
    "scatter that varies": F(lambda m, s, d: torch.zeros_like(s).scatter(-1, (s > 0).long(), s) * m.w0),
    "scatter_add": F(lambda m, s, d: torch.zeros_like(s).scatter_add(-1, (s > 0).long(), s) * m.w0),
    "put_": F(lambda m, s, d: s.clone().put_(torch.tensor([0]), HALF) * m.w0),
    "data": F(lambda m, s, d: s.data * m.w0),
    "data assigned": F(set_data),
    "deepcopy": F(lambda m, s, d: copy.deepcopy(s.detach()) * m.w0),
    "pickle": F(lambda m, s, d: pickle.loads(pickle.dumps(s.detach())) * m.w0),
    "hook on a layer": of_layers(hooked(forward=True)),
    "backward hook": of_layers(hooked(forward=False)),
    "hook on a tensor": F(hook_on_a_tensor),
    "parametrisation": of_layers(parametrised()),
    "tied": of_layers(tied()),
    "frozen": F(lambda m, s, d: m.modules_[0](s) * m.w0, frozen()),
    "straight-through": F(lambda m, s, d: Half.apply(s * m.w0)),
    "inference_mode": F(lambda m, s, d: torch.inference_mode()(torch.sin)(s.detach()).clone() * m.w0 * s),
    "autocast": F(
        lambda m, s, d: torch.autocast("cpu", dtype=torch.bfloat16)(m.modules_[0])(s).double(), nn.Linear(3, 3)
    ),
    "func.jacrev": F(lambda m, s, d: torch.func.vmap(torch.func.jacrev(lambda x: torch.sin(x) * m.w0))(s).sum(-1)),
    "func.jacfwd": F(lambda m, s, d: torch.func.vmap(torch.func.jacfwd(lambda x: torch.sin(x) * m.w0))(s).sum(-1)),
    "func.hessian": F(
        lambda m, s, d: torch.func.vmap(torch.func.hessian(lambda x: (torch.sin(x) * m.w0).sum()))(s).sum(-1)
    ),
    "functional_call": F(
        lambda m, s, d: torch.func.functional_call(m.modules_[0], {"weight": m.modules_[0].weight * 2}, (s,)),
        nn.Linear(3, 3),
    ),
    "autograd.grad enabled": F(slope),
    "autograd.functional.jacobian": F(
        lambda m, s, d: torch.autograd.functional.jacobian(lambda x: (x.sin() * m.w0).sum(), s, create_graph=True)
    ),
    "enable_grad": F(lambda m, s, d: torch.enable_grad()(torch.sin)(s) * m.w0),
    "schedule": Typed(lambda m, s, d: s * m.table[(d.t * 10).long().clamp(0, 19), 3].unsqueeze(-1) * m.w0),
    "diffusion of 60": F(diffusion),
    "bfloat16 inside": F(lambda m, s, d: s.bfloat16().double() * m.w0),
    "int32": F(lambda m, s, d: (s * 10).int().double() * m.w0),
    "uint8": F(lambda m, s, d: (s.abs() * 100).to(torch.uint8).double() * m.w0),
    "int overflow": F(lambda m, s, d: (s * 1e18).long().double() * 1e-18 * m.w0),
    "int8 wraps": F(lambda m, s, d: (s * 100 + 120).to(torch.int32).to(torch.int8).double() * m.w0),
    "int8 arithmetic": F(lambda m, s, d: ((s * 10).to(torch.int8) * 100).double() * m.w0),
    "int64 product": F(lambda m, s, d: ((s * 1e10).long() * 10000000000).double() * 1e-10 * m.w0),
    "int sum to float": F(lambda m, s, d: (s * 10).long().sum(-1, keepdim=True) * m.w0 * s),
    "int true division": F(lambda m, s, d: (s * 10).long() / 3 * m.w0),
    "<<": F(lambda m, s, d: ((s * 10).long() << 1).double() * m.w0),
    "numel": F(lambda m, s, d: s * m.w0 * s.numel()),
    "centred by the batch": F(lambda m, s, d: (s - s.mean(0)) * m.w0),
    "iter tensor": F(lambda m, s, d: torch.stack([row * m.w0 for row in s])),
    "x in tensor": F(lambda m, s, d: s * m.w0 if 0.0 in s else s),
    "sorted": F(lambda m, s, d: torch.stack(sorted(s[0])).unsqueeze(0) * m.w0),
    "round python": F(lambda m, s, d: round(s[0, 0].item()) * s * m.w0),
    "t index": Typed(lambda m, s, d: s * m.table[int(d.t[0] * 10), 0] * m.w0),
    "np.interp": F(lambda m, s, d: s * m.w0 * float(np.interp(s.detach()[0, 0], knots, knots.sin()))),
    "log_softmax": F(lambda m, s, d: s.log_softmax(-1) * m.w0),
    "cosine_similarity": F(lambda m, s, d: FF.cosine_similarity(s, m.A, dim=-1).unsqueeze(-1) * s, A=A3),
    "pairwise_distance": F(lambda m, s, d: FF.pairwise_distance(s, m.A.expand_as(s)).unsqueeze(-1) * s, A=A3),
    "smooth_l1": F(lambda m, s, d: FF.smooth_l1_loss(s, m.w0.expand_as(s), reduction="none")),
    "radial basis": F(lambda m, s, d: torch.exp(-((s.unsqueeze(-1) - m.c) ** 2)).sum(-1), c=torch.randn(5, **D)),
    "polynomial": F(lambda m, s, d: sum(c * s**k for k, c in enumerate(m.c)), c=torch.randn(4, **D)),
    "baddbmm": F(
        lambda m, s, d: torch.baddbmm(s.unsqueeze(-1), torch.diag_embed(s), m.A.expand(len(s), 3, 1)).squeeze(-1),
        A=torch.randn(3, 1, **D),
    ),
    "einsum three": F(lambda m, s, d: torch.einsum("bi,ijk,bk->bj", s, m.A, s), A=torch.randn(3, 3, 3, **D)),
    "mv": with_matrix(lambda m, s, d: m.A.mv(m.w0.repeat(3)) * s),
    "dot": F(lambda m, s, d: torch.dot(m.A, m.A) * s, A=A3),
    "nanmean": F(lambda m, s, d: s.nanmean(-1, keepdim=True) * s * m.w0),
    "clamp tensor": F(lambda m, s, d: s.clamp(-m.w0, m.w0)),
    "relu in place": F(lambda m, s, d: FF.relu_(s * m.w0)),
    "argument changed": F(lambda m, s, d: s.detach().mul_(2.0) * m.w0),
    "weight changed": F(lambda m, s, d: m.w0.data.mul_(1.5) * s),
    "weight view": with_matrix(lambda m, s, d: m.A[0] * s + m.A.view(-1)[:3]),
    "distribution rsample": F(lambda m, s, d: torch.distributions.Normal(s, m.w0.exp()).rsample()),
    "distribution cdf": F(lambda m, s, d: torch.distributions.Normal(0.0, 1.0, validate_args=False).cdf(s) * m.w0),
    "requires_grad_": F(lambda m, s, d: s.detach().clone().requires_grad_() * m.w0),
    "fake quantise": F(lambda m, s, d: torch.fake_quantize_per_tensor_affine(s, 0.1, 0, -128, 127) * m.w0),
    "as_strided": F(lambda m, s, d: s.contiguous().as_strided((len(s), 3), (3, 1)) * m.w0),
    "triu_indices": F(lambda m, s, d: m.A[tuple(torch.triu_indices(2, 2))] * s, A=torch.randn(2, 2, **D)),
    "bucketize int32": F(lambda m, s, d: torch.bucketize(s, knots, out_int32=True) * m.w0),
    "searchsorted right": F(lambda m, s, d: torch.searchsorted(knots, s, side="right") * m.w0),
    "where float32": F(lambda m, s, d: torch.where(s > 0, torch.tensor(0.1), torch.tensor(0.2)) * m.w0 * s),
    "sqrt at zero": F(lambda m, s, d: (s - s).sqrt() * m.w0 + s * m.w0),
    "log of negative": F(lambda m, s, d: s.log() * m.w0),
    "1/0": F(lambda m, s, d: s / 0.0 * m.w0),
    "repr": F(lambda m, s, d: s * m.w0 * float(f"{float(s[0, 0]):.3f}")),
    "is_nonzero": F(lambda m, s, d: s * m.w0 if torch.is_nonzero(s[0, 0]) else s),
    "allclose": F(lambda m, s, d: s * m.w0 if torch.allclose(s, s * 2) else s * 2),
    "storage": F(lambda m, s, d: s * m.w0 * s.storage()[0]),
    "untyped storage": F(lambda m, s, d: s * m.w0 * s.untyped_storage()[0]),
    "memoryview": F(lambda m, s, d: s * m.w0 * np.asarray(memoryview(s.detach().numpy()))[0, 0]),
    "DLPack": F(lambda m, s, d: torch.from_dlpack(s.detach()) * m.w0),
    "np.from_dlpack": F(lambda m, s, d: torch.as_tensor(np.from_dlpack(s.detach())) * m.w0),
    "torch.save": F(saved),
    "scatter_ assigned row": F(
        lambda m, s, d: s.new_zeros(len(s), 3).scatter_(1, torch.zeros(len(s), 1, dtype=torch.long), s[:, :1]) * m.w0
    ),
    "expand then write": F(lambda m, s, d: s[:, :1].expand(-1, 3).clone().add_(1.0) * m.w0),
    "complex as real": F(lambda m, s, d: torch.view_as_real(torch.complex(s, s))[..., 0] * m.w0),
    "unflatten": F(lambda m, s, d: s.unflatten(-1, (3, 1)).flatten(-2) * m.w0),
    "list of floats": F(lambda m, s, d: s * torch.tensor([float(w) for w in m.w0]) * m.w0),
    "weight.item()": F(lambda m, s, d: s * m.w0.item()),
    "branch on a weight": F(lambda m, s, d: s * m.w0 if m.w0 > 0 else -s),
    "weight.data": F(lambda m, s, d: s * m.w0.data),
    "weight.detach().numpy()": F(lambda m, s, d: s * torch.as_tensor(m.w0.detach().numpy() * 2.0)),
    "len of a weight": F(lambda m, s, d: s * len(m.w0) * m.w0),
    "cross": F(lambda m, s, d: torch.cross(s, s.roll(1, -1), dim=-1) * m.w0),
    "renorm": F(lambda m, s, d: torch.renorm(s, 2, 0, 1.0) * m.w0),
    "logdet": with_matrix(lambda m, s, d: torch.logdet(EYE * 5 + torch.diag_embed(s)).unsqueeze(-1) * m.w0),
    "slogdet": with_matrix(lambda m, s, d: torch.linalg.slogdet(EYE * 5 + torch.diag_embed(s))[1].unsqueeze(-1) * m.w0),
    "inverse": with_matrix(lambda m, s, d: s @ m.A.inverse()),
    "tensorinv": with_matrix(lambda m, s, d: s @ torch.linalg.tensorinv(m.A, 1)),
    "corrcoef": F(lambda m, s, d: s * torch.corrcoef(torch.stack([m.A, m.A.sin()]))[0, 1], A=A3),
    "rsqrt etc": F(
        lambda m, s, d: (s.abs() + 1).rsqrt() * s.trunc() * s.ceil() * s.neg() * s.square() * s.reciprocal() * m.w0
    ),
    "log family": F(lambda m, s, d: (s.abs().log2() + s.abs().log10() + s.abs().log1p()) * m.w0),
    "hyperbolic": F(
        lambda m, s, d: (s.sinh() + s.cosh() + s.asinh() + (s.abs() + 1.5).acosh() + s.tanh().atanh()) * m.w0
    ),
    "trig": F(lambda m, s, d: (s.tan() + s.atan() + s.tanh().asin() + s.tanh().acos() + s.sinc()) * m.w0),
}
for kind in ACTIVATIONS:
    CASES[f"{kind}"] = F(lambda m, s, d: m.modules_[0](s) * m.w0, kind)
    CASES[f"wide {kind}"] = F(
        lambda m, s, d: m.modules_[1](m.modules_[0](s)) @ m.A,
        nn.Linear(3, 40),
        copy.deepcopy(kind),
        A=torch.randn(40, 3, **D),
    )


def _by_name(words):
    """Words of messages by the names of cases, from names by the words."""
    return {name: word for word, names in words.items() for name in names}


REFUSED = _by_name(
    {
        "number or a branch": (
            "assert",
            "one_hot of a place",
            "x in tensor",
            "is_nonzero",
            "storage",
            "list of floats",
        ),
        "taken from a tensor that varies": ("weight.item()", "branch on a weight", "list of floats"),
        "takes a number": ("np.sin of detached", "weight.detach().numpy()", "pickle", "torch.save", "untyped storage"),
        "__dlpack__": ("np.from_dlpack",),
        "by a mask": ("mask put tensor",),
        "complex": ("polar", "fft", "complex number", "complex as real"),
        "random": ("RReLU eval", "generator inside"),
        "int8": ("uint8", "int8 wraps", "int8 arithmetic", "deepcopy"),
        "float": ("bfloat16 inside", "int true division", "where float32"),
        "sparse": ("sparse @",),
        "unallocated storage": ("func.jacfwd", "func.hessian"),
        "softshrink": ("Softshrink(0.1)", "wide Softshrink(0.1)"),
        "hardshrink": ("Hardshrink(0.1)", "wide Hardshrink(0.1)"),
        "avg_pool": ("LocalResponseNorm", "AvgPool1d"),
        "slogdet": ("logdet", "slogdet"),
        "no translation": (
            *(
                "cummax",
                "argmin",
                "argsort",
                "kthvalue",
                "orthogonal",
                "cholesky",
                "eigh",
                "svd",
                "qr",
                "lstsq",
                "pinv",
            ),
            *(
                "solve_triangular",
                "bessel",
                "i0",
                "digamma",
                "gcd",
                "frexp",
                "scatter_reduce",
                "<<",
            ),
            *("fake quantise", "allclose", "DLPack"),
        ),
    }
)
UNEQUAL = ("int64 product", "Hardsigmoid()", "wide Hardsigmoid()")
"""Code for which torch computes with other numbers than doubles."""
NO_GRADIENT = ("sqrt at zero", "1/0")
IMPURE = _by_name(
    {
        "gives something else": (
            *(
                "AlphaDropout",
                "RReLU",
                "rand",
                "bernoulli",
                "numpy random",
                "python random",
                "time",
                "argument changed",
            ),
            *("TransformerEncoderLayer dropout", "weight changed", "distribution rsample"),
        ),
        "changes its buffer": ("BatchNorm train", "spectral_norm train"),
        "one realisation alone raises": ("BatchNorm no stats",),
        "depends on the other realisations": (
            *("while until converged", "int(t)", "t index", "torch.tensor of states", "math.sin", "mask read"),
            *("masked_select", "nonzero", "masked_scatter", "index_select that varies", "histc", "bincount", "unique"),
            *("put_", "numel", "centred by the batch", "sorted", "round python", "np.interp", "repr", "memoryview"),
        ),
    }
)
