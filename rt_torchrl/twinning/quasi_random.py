"""Quasi-random draws of Student's distribution: some tens of them reach its tails as often as they should."""

import torch
from jaxtyping import Float
from torch import Tensor


def student(
    count: int, dimensions: int, freedom: int, generator: torch.Generator
) -> Float[Tensor, "{count} {dimensions}"]:
    r"""Draws :math:`x = \xi/s` of a scrambled net, with :math:`\xi \sim \mathcal N(0, I),\ \nu s^2 \sim \chi^2_\nu`.

    Each draw is distributed as an independent one. Together they fill the space evenly, so that means over them scatter
    less. The first component, which counts most, has a dimension of the net of its own; s follows from it:

    .. math:: x_1 \sim t_\nu, \qquad s^2\,(\nu + x_1^2) \sim \chi^2_{\nu + 1}.

    Args:
        count: number of draws.
        dimensions: number of components of a draw, which share s.
        freedom: degrees of freedom ν.
        generator: source of the scrambling.

    Source: Owen, Scrambled net variance for integrals of smooth functions, Ann. Statist. 25 (1997) 1541.
    """
    from scipy.stats import chi2, t  # here, because it takes a second to load and only mixed inputs need it

    seed = int(torch.randint(2**31, (), generator=generator, device=generator.device))
    net = torch.quasirandom.SobolEngine(dimensions + 1, scramble=True, seed=seed)
    unit = net.draw(count, dtype=torch.float64).clamp(2.0**-31, 1.0 - 2.0**-31)
    first = torch.from_numpy(t.ppf(unit[:, :1].numpy(), freedom))
    squared = torch.from_numpy(chi2.ppf(unit[:, 1:2].numpy(), freedom + 1)) / (freedom + first.square())
    return torch.cat([first, torch.special.ndtri(unit[:, 2:]) / squared.sqrt()], 1).to(generator.device)
