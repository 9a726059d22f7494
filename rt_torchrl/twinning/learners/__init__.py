"""Model-free methods for step 2. A name is imported when it is first used, so that configurations need no TorchRL."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
