"""What the page "Connect your machine" prints: its example makes a real system that has not connected yet."""

import pytest
import torch
from printed_commands import blocks
from served_plants import free_port

from rt_torchrl import LinkLostError
from rt_torchrl.systems.real_system import RealSystem


def test_the_example_makes_a_real_system_that_connects_at_its_reset():
    pytest.importorskip("asyncua")
    (code,) = blocks("connect_your_machine.md", "python")
    names = {}
    exec(code.replace("opc.tcp://rig:4840", f"opc.tcp://127.0.0.1:{free_port()}"), names)  # nobody listens there
    system = names["machine"]()
    assert isinstance(system, RealSystem) and system.pace.period == system.plant.dt == 0.05
    client = system.env.env
    assert client.losses == 0
    with pytest.raises(LinkLostError):
        client.link.read()
    low, high = system.env.limits.low, system.env.limits.high
    assert torch.equal(low, -high)
    client.link.close()
