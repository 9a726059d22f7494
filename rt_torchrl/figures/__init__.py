"""Figures of a training, each from a :class:`Snapshot`, for any plant.

``__init__.pyi`` lists them. A figure is imported when it is first used, so that a training starts without Matplotlib.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
