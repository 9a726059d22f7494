"""A module of settings, as users have it: what it holds changes in the table of ``changes.py``."""

import types

SCALE = 0.1
CONFIG = {"scale": 0.1}
OPTIONS = types.SimpleNamespace(scale=0.1)


def scale():
    return CONFIG["scale"]


class Constants:
    """A namespace."""

    scale = 0.1
    table = {"scale": 0.1}

    @staticmethod
    def read():
        return SCALE
