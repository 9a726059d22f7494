"""A wind turbine served over OPC UA or Modbus: reinforcement twinning while it operates, or a policy at work."""

import contextlib
import time
from dataclasses import field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

from pydantic import Field
from wind_turbine import Config as Turbine
from wind_turbine import plant_figures

from rt_torchrl import OperationConfig, configuration, main_of
from rt_torchrl.atomic_file import make_folder, write_results
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.options import File, Positive

SAFE = (2e4, 20.0)
"""Torque [N m] and pitch [deg] that slow the rotor down in any wind, and do not stop it."""


def in_operation() -> OperationConfig:
    """The turbine never stops, and keeps its own time."""
    return OperationConfig(clock="wall", continuous=True)


@configuration
class Config(Turbine):
    """Train twin and controllers on a wind turbine at the other end of a protocol, while it operates.

    A server process simulates the turbine and never waits; this process connects to it as a client would to a machine.
    The policies are judged in simulation.

    Args:
        protocol: what the server speaks, opcua or modbus.
        port: port of the server on this machine.
        connect: whether a server runs already, started with serve; it must have the same dt, pace and observe.
        serve: whether to run the server alone, until Ctrl-C.
        act: exported policy that acts for one horizon, without a learner: an ONNX model (.onnx, with the extra export),
            or with trusted a PyTorch program (.pt2) or C (.c, with a C compiler). The results, in_service.json, and the
            events of the safety layer, safety.jsonl, go to log_dir.
        trusted: whether a .pt2 or .c file may run its code, because you know who has written it.
        pace: seconds of the turbine for each second: with the default, the control period of 0.5 s lasts 0.02 s.
        safe: generator torque [N m] and blade pitch [deg] that the turbine's own watchdog brings, and the client's
            fallback.
    """

    asynchronous: bool = True
    operation: OperationConfig = field(default_factory=in_operation)
    protocol: Literal["opcua", "modbus"] = "modbus"
    port: Annotated[int, Field(ge=1, le=65535)] = 5020
    connect: bool = False
    serve: bool = False
    act: File | None = None
    trusted: bool = False
    pace: Positive = 25.0
    safe: tuple[float, float] = SAFE

    def __post_init__(self):
        super().__post_init__()
        if self.asynchronous and self.operation.clock != "wall":
            raise ValueError("operation.clock must be wall: a served plant keeps its own time and does not wait.")
        for option, usual in (("real", "simulation"), ("unknown", ()), ("model_error", False)):
            value = getattr(self, option)
            if value != usual:
                raise ValueError(
                    f"{option}={value!r} is another real system; the served one is the simulation that its twin knows. "
                    f"Leave {option} out, or take recipes/wind_turbine.py."
                )
        if self.serve and (self.connect or self.act is not None):
            raise ValueError(
                "serve=True runs the server alone, and connect and act are options of a client; give them to another "
                "process."
            )

    @staticmethod
    def usual_operation() -> OperationConfig:
        return in_operation()

    def served(self) -> dict[str, Any]:
        """Arguments of server and client."""
        return {"safe": self.safe, "protocol": self.protocol, "port": self.port, "period": self.dt / self.pace}


def main(config: Config, **parts: Any) -> None:
    """Train; ``parts`` are further arguments of :class:`Run`, such as ``learner``."""
    from rt_torchrl import Run, ServerProcess, served_system  # here, because --help need not wait for TorchRL

    plant = config.plant()
    server = contextlib.nullcontext() if config.connect else ServerProcess(plant, **config.served(), seed=config.seed)
    with server:
        if config.serve:
            print(f"the turbine is served over {config.protocol} on port {config.port}; Ctrl-C ends it", flush=True)
            while True:
                time.sleep(1.0)
        if config.act is not None:
            act(config, config.act)
            return
        env = partial(served_system, plant, **config.served(), closure=plant.closure)
        Run(config, plant, env=env, plant_figures=plant_figures, first=JonkmanController, **parts).train()


def act(config: Config, file: Path) -> None:
    """Let an exported policy act for one horizon, and write what came of it."""
    import torch

    from rt_torchrl import ExplorationConfig, load_policy, served_system
    from rt_torchrl.systems.collectors import EpisodeCollector
    from rt_torchrl.systems.exploration import LivePolicy

    torch.set_num_threads(1)
    folder, plant = config.log_dir or Path("runs/in_service"), config.plant()
    make_folder("log_dir", folder)
    policy, log = load_policy(file, plant, trusted=config.trusted), folder / "safety.jsonl"
    log.unlink(missing_ok=True)
    actor = LivePolicy(plant, policy, ExplorationConfig(episodes=0), generator=torch.Generator())
    actor.begin(policy, strength=0.0)
    system = served_system(plant, **config.served(), log=log)
    with contextlib.closing(system):
        episode = EpisodeCollector(system, actor, plant).rollout()[0]
    client = system.env.env
    results = {
        "J_a": -episode["next", "reward"].mean().item(),
        "intervals": float(plant.n_steps),
        "refused": float(episode["next", "refused"].sum()),
        "skipped": float(client.skipped),
        "late_answers": float(client.late),
        "lost_connections": float(client.losses),
    }
    path = write_results(folder / "in_service.json", {"config": config, **results})
    for name, value in results.items():
        print(f"{name.replace('_', ' '):<24}{value:.6g}")
    print(f"results in {path}")


if __name__ == "__main__":
    main_of(Config, main)
