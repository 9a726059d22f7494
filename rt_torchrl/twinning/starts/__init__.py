"""What a training begins with instead of random weights."""

from rt_torchrl.twinning.starts.controller import FirstController
from rt_torchrl.twinning.starts.earlier_policies import EarlierPolicies
from rt_torchrl.twinning.starts.recorded_flights import RecordedFlights
from rt_torchrl.twinning.starts.start import Fly, Start, first_live

__all__ = ["EarlierPolicies", "FirstController", "Fly", "RecordedFlights", "Start", "first_live"]
