"""Packages that are imported when something of them is first used, whoever imports them by name before."""

import sys
from importlib.util import find_spec, module_from_spec
from types import ModuleType
from typing import Any


class DelayedPackage(ModuleType):
    """A package that has been found but not run; the first use of anything in it runs it, in this very module.

    ``importlib.util.LazyLoader`` does not serve here, because ``import`` itself reads the module's ``__spec__``, which
    loads what that loader has put off.
    """

    def __getattr__(self, name: str) -> Any:
        spec = self.__spec__
        assert spec is not None and spec.loader is not None
        super().__setattr__("__class__", ModuleType)  # from here on an ordinary module, which its own code may import
        self.__path__ = spec.submodule_search_locations or []
        try:
            spec.loader.exec_module(self)
        except BaseException:
            sys.modules.pop(spec.name, None)  # as after an import that fails, so that the next one tries again
            raise
        return getattr(self, name)


def delay_import(package: str) -> None:
    """Let ``import package`` cost nothing until the package is used; a package that is not installed stays so.

    Args:
        package: name of an installed package that others import and that this process may never use.
    """
    if package in sys.modules or (spec := find_spec(package)) is None:
        return
    module = module_from_spec(spec)
    del module.__path__  # an import of a submodule asks for it, and runs the package first
    module.__class__ = DelayedPackage
    sys.modules[package] = module
