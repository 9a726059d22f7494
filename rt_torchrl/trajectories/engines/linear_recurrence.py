r"""The linear recurrence :math:`x_k = A_k x_{k-1} + b_k`, in a number of steps that grows with the logarithm of n."""

import torch
from torch import Tensor


def linear_recurrence(transitions: Tensor, sources: Tensor) -> Tensor:
    r"""All :math:`x_0 = b_0,\; x_k = A_k x_{k-1} + b_k` at once, by odd-even reduction.

    Two steps make one, :math:`x_k = A_kA_{k-1}x_{k-2} + (A_kb_{k-1} + b_k)`, so that the odd x follow from a recurrence
    of half the length, and the even ones from them. This takes 2 log2 n batched products in a row and n products of two
    matrices in all.

    Args:
        transitions: :math:`A_1 \dots A_{n-1}`, ``n-1 batch n_s n_s``.
        sources: :math:`b_0 \dots b_{n-1}`, ``n batch n_s``.

    Returns:
        :math:`x_0 \dots x_{n-1}`, ``n batch n_s``.

    Source: Blelloch, *Prefix sums and their applications*, CMU-CS-90-190 (1990), section 1.4.1.
    """
    if len(sources) == 1:
        return sources
    to_odd, to_even = transitions[::2], transitions[1::2]
    half = len(to_odd)
    joined = _applied(to_odd, sources[: 2 * half : 2]) + sources[1::2]
    odd = linear_recurrence(to_odd[1:] @ to_even[: half - 1], joined)
    found = torch.empty_like(sources)
    found[0], found[1::2] = sources[0], odd
    found[2::2] = _applied(to_even, odd[: len(to_even)]) + sources[2::2]
    return found


def _applied(matrices: Tensor, vectors: Tensor) -> Tensor:
    return (matrices @ vectors.unsqueeze(-1)).squeeze(-1)
