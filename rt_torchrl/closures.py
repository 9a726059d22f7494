"""Closures of general use: any ``closure(features) -> coefficients`` can stand in for a plant's own."""

import torch
from jaxtyping import Float
from torch import Tensor, nn


class PositiveCoefficients(nn.Module):
    """Base of a closure with a few positive coefficients; a subclass names them and says in ``forward`` what they do.

    The trained weights are the logarithms: the coefficients stay positive, and a step changes each by the same
    percentage, whatever its size and unit.

    Args:
        coefficients: in the order and the units of ``names``.

    Raises:
        ValueError: if their number is wrong or one of them is not positive and finite.
    """

    names: dict[str, str]
    """Unit of each coefficient, by name."""
    true_coefficients: tuple[float, ...]
    """Those of the real system."""

    def __init__(self, coefficients: Float[Tensor, " n"]):
        super().__init__()
        coefficients = torch.as_tensor(coefficients, dtype=torch.float64)
        shape = (len(self.names),)
        if coefficients.shape != shape or not (coefficients.isfinite() & (coefficients > 0.0)).all():
            wanted = ", ".join(f"{name} [{unit}]" for name, unit in self.names.items())
            raise ValueError(
                f"coefficients={coefficients.tolist()} of {type(self).__name__} must be {wanted}, positive and finite; "
                f"those of the paper are {self.true_coefficients}."
            )
        self.log_coefficients = nn.Parameter(coefficients.log())

    @classmethod
    def true(cls) -> "PositiveCoefficients":
        """Those of the real system; the weights are frozen, they are not what is learned."""
        return cls(torch.tensor(cls.true_coefficients, dtype=torch.float64)).requires_grad_(False)

    @property
    def coefficients(self) -> Float[Tensor, " n"]:
        """In the units of ``names``."""
        return self.log_coefficients.exp()

    def named_coefficients(self) -> dict[str, Tensor]:
        """The coefficients by name."""
        return dict(zip(self.names, self.coefficients.unbind(), strict=True))
