"""An exported policy in service: it acts on a served wind turbine, without a learner."""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import torch
from served_turbine import SAFE, server_of
from served_turbine import Config as Served
from tyro.conf import Positional

from rt_torchrl import check_options, main_of
from rt_torchrl.runs.results_file import make_folder, write_results


@dataclass(frozen=True, kw_only=True)
class Config:
    """Let an exported policy act on a served wind turbine.

    Args:
        policy: file of recipes/export.py: an ONNX model (.onnx, with the extra onnx); or, with --trusted, a PyTorch
            program (.pt2) or C (.c, with a C compiler), which run code of their own here as any program does.
        trusted: whether a .pt2 or .c file may run its code, because you know who has written it.
        observe: what the policy observes, as in the training; a run's config.json says it.
        protocol: what the server speaks, opcua or modbus.
        port: port of the server on this machine.
        connect: whether a server runs already.
        pace: seconds of the turbine for each second.
        seconds: time for which the policy acts [s of the turbine].
        seed: seed of the wind, if the server is started here.
        log_dir: folder of the results, in_service.json, and of the events of the safety layer, safety.jsonl.
    """

    policy: Annotated[Path, Positional]
    trusted: bool = False
    observe: tuple[str, ...] = ("measured+wind",)
    protocol: Literal["opcua", "modbus"] = "modbus"
    port: int = 5020
    connect: bool = False
    pace: float = 25.0
    seconds: float = 600.0
    seed: int = 0
    log_dir: Path = Path("runs/in_service")

    def __post_init__(self):
        check_options(self)
        if not self.seconds > 0.0:
            raise ValueError(f"seconds={self.seconds} s must be positive.")

    def served(self) -> Served:
        """The turbine with the horizon of the time in service."""
        options = {"protocol": self.protocol, "port": self.port, "pace": self.pace, "seed": self.seed}
        return Served(observe=self.observe, horizon=self.seconds, **options)


def main(config: Config) -> None:
    # Here, because --help need not wait for TorchRL.
    from rt_torchrl import ExplorationConfig, load_policy, served_system
    from rt_torchrl.systems.collectors import EpisodeCollector
    from rt_torchrl.systems.exploration import LivePolicy

    torch.set_num_threads(1)
    make_folder("log_dir", config.log_dir)
    served = config.served()
    plant = served.plant()
    policy = load_policy(config.policy, plant, trusted=config.trusted)
    options = {"protocol": config.protocol, "port": config.port, "period": served.period}
    log = config.log_dir / "safety.jsonl"
    log.unlink(missing_ok=True)
    system = served_system(plant, safe=SAFE, log=log, **options)
    actor = LivePolicy(plant, policy, ExplorationConfig(episodes=0), generator=torch.Generator())
    actor.begin(policy, strength=0.0)
    with contextlib.nullcontext() if config.connect else server_of(served):
        try:
            episode = EpisodeCollector(system, actor, plant).rollout()[0]
        finally:
            system.close()
    client = system.env.env
    found = {
        "J_a": -episode["next", "reward"].mean().item(),
        "intervals": float(plant.n_steps),
        "refused": float(episode["next", "refused"].sum()),
        "skipped": float(client.skipped),
        "late_answers": float(client.late),
        "lost_connections": float(client.losses),
    }
    path = write_results(config.log_dir / "in_service.json", {"config": config, **found})
    for name, value in found.items():
        print(f"{name.replace('_', ' '):<24}{value:.6g}")
    print(f"results in {path}")


if __name__ == "__main__":
    main_of(Config, main)
