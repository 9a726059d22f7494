"""A served plant as a real system: link, pace, safety layer and readings together."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from torch import nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.systems.protocols.connected_plant import ConnectedPlant
from rt_torchrl.systems.protocols.link import Link
from rt_torchrl.systems.protocols.modbus import WRITTEN_AT, ModbusLink, own_registers
from rt_torchrl.systems.protocols.opc_ua import OpcUaLink, own_nodes
from rt_torchrl.systems.protocols.tags import ANSWERED, SAMPLE, Tags
from rt_torchrl.systems.reading import Reading
from rt_torchrl.systems.real_system import RealSystem
from rt_torchrl.systems.safety import SafetyLayer
from rt_torchrl.systems.safety_config import SafetyConfig

Protocol = Literal["opcua", "modbus"]
ANSWER = 0.8
"""Share of the period within which the plant must answer a request."""
HOST = "127.0.0.1"
"""Address of the server, which is on this machine."""
NONE = (-0.5, 0.5)
"""Range of a number of skipped samples that are none."""


def link_to(protocol: Protocol, tags: Tags, port: int, *, period: float) -> Link:
    """The link to a plant that is served on this machine.

    Args:
        protocol: what the server speaks.
        tags: tags of the plant.
        port: port of the server.
        period: control period on the wall clock [s].
    """
    timeout = ANSWER * period
    if protocol == "opcua":
        return OpcUaLink(f"opc.tcp://{HOST}:{port}", own_nodes(tags.read), own_nodes(tags.written), timeout=timeout)
    read, written = own_registers(tags.read), own_registers(tags.written, WRITTEN_AT)
    return ModbusLink(HOST, port, read, written, timeout=timeout)


def served_system(
    plant: Plant,
    *,
    safe: Sequence[float],
    protocol: Protocol = "opcua",
    port: int = 4840,
    period: float | None = None,
    served: Plant | None = None,
    closure: nn.Module | None = None,
    log: Path | None = None,
    patience: float = 60.0,
) -> RealSystem:
    """The real system at the other end of a protocol. The connection is made at the first reset.

    Args:
        plant: physics of the twin, with the signals of the served plant.
        safe: action of the fallback, one number for each actuator; the plant's own watchdog should have the same.
        protocol: what the server speaks.
        port: port of the server on the local machine.
        period: control period on the wall clock [s]; by default the plant's control interval.
        served: plant at the other end, if it does not serve all states of ``plant``, such as past observations; the
            :attr:`Plant.controller_states` are then computed here, see :class:`RealSystem`.
        closure: the true closure, if policies are to be judged in simulation; else None.
        log: file of the safety layer's events.
        patience: time for which a reset waits for the plant to answer [s].

    Raises:
        ValueError: if the served plant does not serve a state that is measured.
    """
    computed = () if served is None else plant.controller_states
    measured = tuple(signal for signal in plant.readings if signal.name not in computed)
    tags, wall = Tags.of(served or plant), plant.dt if period is None else period
    missing = {signal.name for signal in measured} - {signal.name for signal in tags.states}
    if missing:
        raise ValueError(
            f"served={(served or plant).name!r} lacks {', '.join(sorted(missing))}, which plant {plant.name!r} reads."
        )
    link = link_to(protocol, tags, port, period=wall)
    entries = {key: names for key, names in dataclasses.replace(tags, states=measured).entries.items() if names}
    env = ConnectedPlant(
        link,
        entries,
        tags.commands,
        plant.actions,
        period=wall,
        sample=SAMPLE,
        answered=ANSWERED,
        patience=patience,
    )
    low, high = [s.low for s in measured], [s.high for s in measured]
    bounded = {"skipped": NONE} | ({"state": (low, high)} if any(map(math.isfinite, (*low, *high))) else {})
    guarded = SafetyLayer(env, SafetyConfig(interval=plant.dt, ranges=bounded, log=log), fallback=tuple(safe))
    exogenous = Reading(keys=("exogenous",)) if plant.inputs else None
    return RealSystem(
        guarded,
        plant,
        state=Reading(keys=("state",)),
        exogenous=exogenous,
        applied=Reading(keys=("applied",)),
        closure=closure,
        computes=served is not None,
        seed=None,
    )
