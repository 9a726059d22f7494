"""Fixtures that more than one file uses."""

import jaxtyping
import pytest


@pytest.fixture
def unchecked():
    """Without the run-time checks of annotations, for values that these would refuse before the library does."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
