"""The interface of Bladed: our library against the policy in torch, ROSCO's controller on our turbine, and faults."""

import ctypes
import math
import subprocess
from pathlib import Path

import pytest
import torch
from c_build import COMPILER, library, needs_compiler
from printed_commands import TEXTS, blocks, run_code
from seeds_and_numbers import drawn, seeded

from rt_torchrl import DISCON, SaturatedAffine, StateFeedback, export_discon
from rt_torchrl.contract.check import require_controller
from rt_torchrl.envs.wind_turbine.controllers import GainScheduled
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.export.c_controller import Controller
from rt_torchrl.trajectories.state_feedback import Remembering

N_G = 97.0
HALF = 2.0**-24
"""Greatest relative error of a number in single precision, in which the swap array passes it."""


def single(x):
    return x.float().double()


def exported(folder, policy, plant):
    """The library of a policy, checked on 10 intervals."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rt_torchrl.export.c_controller.INTERVALS", 10)
        assert export_discon(policy, folder / "discon.c", plant) < 1e-9
    return folder / "libdiscon.so"


@pytest.fixture(scope="module")
def scheduled(tmp_path_factory):
    """A turbine, a gain-scheduled policy, its library, and two whole episodes that the library flies."""
    if COMPILER is None:
        pytest.skip("no C compiler here")
    plant = WindTurbine(observe=("scheduled",))
    policy, start, wind = GainScheduled(plant, generator=seeded(4)), *drawn(plant, 2, 5)
    file = exported(tmp_path_factory.mktemp("scheduled"), policy, plant)
    return plant, policy, file, DISCON(plant, file).fly(start, wind)


def in_torch(plant, policy, flown, passed):
    """The actions of the controller in torch, whose measurements pass the swap array as a function says."""
    controller, actions, before = Controller(plant, policy), [], None
    for k, (state, wind) in enumerate(zip(flown.states[:, :-1].unbind(1), flown.exogenous.unbind(1), strict=True)):
        speed, wind = passed(N_G * state[:, :1]) / N_G, passed(wind)
        t = torch.tensor([k * plant.dt], dtype=torch.float64)
        if before is None:
            memory = controller.start(speed, wind)
            memory[:, 3], memory[:, 4] = passed(state[:, 4]), passed(state[:, 5].deg2rad()).rad2deg()
        else:
            memory = controller.advance(t - plant.dt, *before, speed)
        command, action = controller.act(t, memory, speed, wind)
        before = memory, speed, wind, command
        actions.append(action)
    return torch.stack(actions, 1)


@torch.no_grad()
def test_a_library_commands_what_the_policy_commands(scheduled):
    """Whole episodes: to the rounding of the demands for the same measurements, to 1e-6 of them for exact ones."""
    plant, policy, _, flown = scheduled
    assert flown.actions.shape == (2, 1200, 2) and flown.actions.std(1).min() > 0.1
    twice = flown.mapped(lambda x: torch.cat([x, x]))
    expected, exact = in_torch(plant, policy, twice, lambda x: torch.cat([single(x[:2]), x[2:]])).split(2)
    assert ((flown.actions - expected).abs() <= (HALF + 1e-9) * expected.abs()).all()
    assert 0.0 < ((flown.actions - exact).abs() / exact.new_tensor([43_093.55, 30.0])).max() < 1e-6


# The library by itself, called without this library's class.


class Called:
    """A library in C with the records of a turbine that runs at rated speed."""

    def __init__(self, path):
        self.discon, self.failed = ctypes.CDLL(str(path)).DISCON, ctypes.c_int(7)
        self.swap, self.message = (ctypes.c_float * 130)(*[9.0] * 130), ctypes.create_string_buffer(200)
        self.tell({1: 0, 2: 0.0, 3: 0.5, 4: math.radians(5.0), 10: 0, 20: 122.0, 23: 20e3, 27: 12.0, 49: 200})

    def tell(self, records):
        for record, value in records.items():
            self.swap[record - 1] = value

    def call(self, **records):
        self.tell({int(name[1:]): value for name, value in records.items()})
        self.discon(self.swap, ctypes.byref(self.failed), b"", b"", self.message)
        return self.failed.value, self.message.value.decode()


def most(plant):
    """A policy that wants the greatest torque and no pitch, whatever it sees."""
    policy = SaturatedAffine(len(plant.observations), plant.actions, generator=seeded())
    with torch.no_grad():
        policy.linear.weight.zero_()
        policy.linear.bias.copy_(torch.tensor([50.0, -50.0], dtype=torch.float64))
    return policy


@needs_compiler
def test_a_library_starts_from_what_is_applied_and_keeps_the_rates(tmp_path):
    """15 kN m/s and 8 deg/s over 0.5 s; a new first call starts anew, and the last call demands nothing new."""
    plant = WindTurbine()
    exported(tmp_path, most(plant), plant)
    library(tmp_path / "discon.c")  # without a warning
    called = Called(tmp_path / "discon.so")
    for k, (torque, pitch) in enumerate([(27_500.0, 1.0), (35_000.0, 0.0), (42_500.0, 0.0), (43_093.55, 0.0)]):
        assert called.call(r1=min(k, 1), r2=0.5 * k) == (0, "")
        assert called.swap[46] == pytest.approx(torque, rel=1e-7)
        demanded = [called.swap[record - 1] for record in (42, 43, 44, 45)]
        assert demanded == pytest.approx([math.radians(pitch)] * 4, rel=1e-6, abs=1e-9)
        assert called.swap[34] == 1.0  # the generator is on; brake, overrides and logging are off
        assert all(called.swap[record - 1] == 0.0 for record in (36, 41, 46, 48, 55, 56, 65))
    assert called.call(r1=-1) == (0, "") and called.swap[46] == pytest.approx(43_093.55, rel=1e-7)
    called.call(r1=0, r2=300.0)
    assert called.swap[46] == pytest.approx(27_500.0, rel=1e-7)
    assert called.call(r1=1, r2=300.5)[0] == 0


@needs_compiler
def test_wrong_calls_fail_with_words(tmp_path):
    plant = WindTurbine()
    file = exported(tmp_path, most(plant), plant)
    called = Called(file)
    for records, words in (
        ({"r3": 0.0125}, "wind_turbine_controller: the communication interval is 0.0125 s and must be 0.5 s"),
        ({"r3": 0.5, "r10": 1}, "asks for pitch rates"),
        ({"r10": 0, "r20": math.nan}, "a speed, the torque or the pitch is not finite at t = 0 s"),
        ({"r20": 122.0, "r23": math.inf}, "the torque or the pitch is not finite at t = 0 s"),
        ({"r23": 20e3, "r1": -9}, r"restart files (iStatus -9) are not supported"),
        ({"r1": 0}, None),
        ({"r1": 1, "r2": 0.05}, "called at t = 0.05 s instead of 0.5 s; call it every 0.5 s."),
        ({"r2": 0.5}, None),  # a call that failed has changed nothing
    ):
        failed, message = called.call(**records)
        assert (failed, message) == (0, "") if words is None else failed == -1 and words in message
    called.tell({49: 20})  # characters of a message
    assert called.call(r2=0.5)[1] == "wind_turbine_contro"


# Any library as a controller here.


def compiled(folder, body, name="other"):
    """A library of a function DISCON with the given body, or of the whole text that is given."""
    head = "void DISCON(float *s, int *fail, char *in, char *out, char *message)\n"
    text = body if "(" in body.partition("{")[0] else f"#include <string.h>\n{head}{body}"
    (folder / f"{name}.c").write_text(text)
    subprocess.run([COMPILER, "-shared", "-fPIC", folder / f"{name}.c", "-o", folder / f"{name}.so"], check=True)
    return folder / f"{name}.so"


@needs_compiler
def test_a_library_is_told_the_state_of_the_turbine(tmp_path):
    """The electrical power at rated speed and torque is 5 MW; the pitch comes back in degrees."""
    plant, read = WindTurbine(), {1: [], 2: [], 15: [], 20: [], 21: [], 23: [], 27: [], 61: [], 51: []}
    state = torch.tensor([[1.26711, 0.0, 0.0, 0.0, 43_093.55, 3.0]], dtype=torch.float64)
    wind = torch.tensor([[13.0]], dtype=torch.float64)
    for record, found in read.items():
        body = f"{{ s[46] = s[{record - 1}] + 10.0f; s[44] = s[3]; (void)fail, (void)in, (void)out, (void)message; }}"
        controller = DISCON(plant, compiled(tmp_path, body, f"r{record}"))
        for _ in range(2):
            torque, pitch = controller.act(9.0, state, wind).unbind(-1)
            found.append(torque.item() - 10.0)
            assert pitch.item() == pytest.approx(3.0, rel=1e-6)
    assert read[1] == [0.0, 1.0] and read[2] == [0.0, 0.5] and read[61] == [3.0, 3.0] and read[51][0] > 10.0
    assert read[20] == pytest.approx([122.91] * 2, rel=1e-5) and read[21] == pytest.approx([1.26711] * 2, rel=1e-5)
    assert read[27] == [13.0] * 2 and read[23] == read[15] == [43_083.55] * 2  # clamped to the rated torque
    assert plant.generator_efficiency * 43_093.55 * 122.9096 == pytest.approx(5e6)


@needs_compiler
def test_a_library_may_fail_or_warn(tmp_path):
    plant = WindTurbine(horizon=5.0)
    start, wind = drawn(plant, 1, 5)
    fails = DISCON(plant, compiled(tmp_path, '{ *fail = s[1] > 0.9f ? -1 : 0; strcpy(message, "no oil"); }', "fails"))
    for _ in range(2):  # a failed library is left behind
        with pytest.raises(ValueError, match=r"fails\.so failed at t = 1 s: no oil"):
            fails.fly(start, wind)
    warns = DISCON(plant, compiled(tmp_path, '{ *fail = 1; strcpy(message, "little oil"); }', "warns"))
    with pytest.warns(UserWarning, match=r"warns\.so: little oil"):
        assert warns.fly(start, wind).actions.shape == (1, 10, 2)


def test_roscos_controller_flies_our_turbine(capfd):
    """NREL's tuning holds the speed; two episodes do not mix."""
    rosco = pytest.importorskip("rosco")
    file = Path(rosco.__file__).parent.parent / "Examples" / "Test_Cases" / "NREL-5MW" / "DISCON.IN"
    plant = WindTurbine(horizon=200.0)
    controller, (start, wind) = DISCON(plant, rosco.discon_lib_path, file), drawn(plant, 2, 5)
    flown = controller.fly(start, wind)
    speed = plant.gear_ratio * flown.states[:, 100:, 0]
    power = plant.generator_power(flown.states[:, :-1], flown.actions)
    assert 100.0 < speed.mean() < 125.0 and speed.max() < 1.2 * plant.rated_generator_speed
    assert 3.0e6 < power[:, 100:].mean() < 5.0e6 and flown.actions[..., 1].max() > 3.0
    assert torch.equal(controller.fly(start[1:], wind[1:]).states[0], flown.states[1])


@pytest.mark.slow
def test_the_code_of_the_page_prints_what_it_says(capfd):
    pytest.importorskip("rosco")
    (code,) = blocks("discon.md", "python")
    for dt, cost in (("0.1", "0.0434"), ("0.5", "0.0495")):
        assert f"prints {cost}" in TEXTS["discon.md"]
        run_code("discon.md", code.replace("dt=0.1", f"dt={dt}"))
        assert f"tensor({cost}, dtype=torch.float64)" in capfd.readouterr().out


def test_a_controller_by_a_library_is_judged_as_a_classical_one(scheduled):
    """A training takes a class; none of its flights is compiled, because the library is no function of a memory."""
    plant = WindTurbine(observe=("scheduled",), horizon=20.0)

    class Ours(DISCON):
        def __init__(self, plant):
            super().__init__(plant, scheduled[2])

    require_controller("baselines['ours']", Ours, plant)
    controller, unseen = Ours(plant), UnseenEpisodes(plant, 2)
    assert isinstance(controller, StateFeedback) and not isinstance(controller, Remembering)
    assert unseen.judge(unseen.fly(controller)).control_costs.isfinite().all()
