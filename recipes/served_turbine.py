"""Reinforcement twinning of a wind turbine that is served over OPC UA or Modbus, while it operates."""

import contextlib
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

from wind_turbine import Config as Turbine
from wind_turbine import plant_figures

from rt_torchrl import OperationConfig, main_of
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController

SAFE = (2e4, 20.0)
"""Torque [N m] and pitch [deg] that slow the rotor down in any wind, and do not stop it."""


def in_operation() -> OperationConfig:
    """The turbine never stops, and keeps its own time."""
    return OperationConfig(clock="wall", continuous=True)


@dataclass(frozen=True, kw_only=True)
class Config(Turbine):
    """Train twin and controllers on a wind turbine at the other end of a protocol, while it operates.

    A server process simulates the turbine and never waits; this process connects to it as a client would to a machine.
    The policies are judged in simulation.

    Args:
        protocol: what the server speaks, opcua or modbus.
        port: port of the server on this machine.
        connect: whether a server runs already, started with serve; it must have the same dt, pace and observe.
        serve: whether to run the server alone, until Ctrl-C.
        pace: seconds of the turbine for each second: with the default, the control period of 0.5 s lasts 0.02 s.
        safe: generator torque [N m] and blade pitch [deg] that the turbine's own watchdog brings, and the client's
            fallback.
    """

    asynchronous: bool = True
    operation: OperationConfig = field(default_factory=in_operation)
    protocol: Literal["opcua", "modbus"] = "modbus"
    port: int = 5020
    connect: bool = False
    serve: bool = False
    pace: float = 25.0
    safe: tuple[float, float] = SAFE

    def __post_init__(self):
        super().__post_init__()
        if not self.pace > 0.0:
            raise ValueError(f"pace={self.pace} must be positive, in seconds of the turbine for each second.")
        if not 0 < self.port < 65536:
            raise ValueError(f"port={self.port} must lie in 1 ... 65535.")
        if self.asynchronous and self.operation.clock != "wall":
            raise ValueError("operation.clock must be wall: a served plant keeps its own time and does not wait.")
        if self.real != "simulation":
            raise ValueError(f"real={self.real!r} is another real system; the served one is the simulation.")

    @staticmethod
    def usual_operation() -> OperationConfig:
        return in_operation()

    @property
    def period(self) -> float:
        """Wall-clock time of a control interval [s]."""
        return self.dt / self.pace


def server_of(config: Config):
    """The context in which the turbine is in operation in a process of its own."""
    from rt_torchrl import ServerProcess

    options = {"protocol": config.protocol, "port": config.port, "period": config.period, "seed": config.seed}
    return ServerProcess(config.plant(), config.safe, **options)


def main(config: Config, **parts: Any) -> None:
    """Train; ``parts`` are further arguments of :class:`Run`, such as ``learner``."""
    from rt_torchrl import Run, served_system  # here, because --help need not wait for TorchRL

    if config.serve:
        return serve_alone(config)
    plant = config.plant()
    env = partial(
        served_system,
        plant,
        safe=config.safe,
        protocol=config.protocol,
        port=config.port,
        period=config.period,
        closure=plant.closure,
    )
    with contextlib.nullcontext() if config.connect else server_of(config):
        Run(config, plant, env=env, plant_figures=plant_figures, first=JonkmanController, **parts).train()
    return None


def serve_alone(config: Config) -> None:
    """Serve the turbine until Ctrl-C."""
    import time

    with server_of(config):
        print(f"the turbine is served over {config.protocol} on port {config.port}; Ctrl-C ends it", flush=True)
        while True:
            time.sleep(1.0)


if __name__ == "__main__":
    main_of(Config, main)
