"""One call that checks the contract of a plant, see :func:`check_plant`."""

from rt_torchrl.contract.check import ContractReport, PlantContractError, check_plant

__all__ = ["ContractReport", "PlantContractError", "check_plant"]
