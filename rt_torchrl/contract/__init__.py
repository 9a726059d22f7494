"""What a plant must fulfil, checked in one call: see :func:`check_plant`."""

from rt_torchrl.contract.check import ContractReport, PlantContractError, check_plant

__all__ = ["ContractReport", "PlantContractError", "check_plant"]
