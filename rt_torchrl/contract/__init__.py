"""What a plant must fulfil, checked in one call: see :func:`check_plant`."""

from rt_torchrl.contract.check import PlantContractError, check_plant

__all__ = ["PlantContractError", "check_plant"]
