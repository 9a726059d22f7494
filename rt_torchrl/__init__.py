"""Reinforcement Twinning: a digital twin and two controllers, trained while the real system runs.

Every public name is imported from here. ``__init__.pyi`` lists the names and where each one is defined; a name is
imported when it is first used, so that ``import rt_torchrl`` itself does not wait for PyTorch and TorchRL.
"""

import lazy_loader

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
