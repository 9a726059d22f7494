"""The file ``modelDescription.xml`` of an FMU for co-simulation, of FMI 2.0 and of FMI 3.0."""

import platform
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from xml.sax.saxutils import quoteattr

from rt_torchrl.plants.signal import Signal

SYSTEMS = {"win32": "windows", "darwin": "darwin"}


@dataclass(frozen=True, kw_only=True)
class FMUDescription:
    """What ``modelDescription.xml`` says; a variable is called KIND.NAME, such as ``state.rotor_speed``.

    Args:
        name: name of the model and of its library.
        token: what the library knows itself by.
        dt: control interval [s].
        inputs, outputs: kind and signal of each variable, in the order of the values.
        values: values at the start.
    """

    name: str
    token: str
    dt: float
    inputs: Sequence[tuple[str, Signal]]
    outputs: Sequence[tuple[str, Signal]]
    values: Sequence[float]

    def text(self, version: str) -> str:
        """The content of the file, for FMI 2.0 or 3.0."""
        return self._second() if version == "2.0" else self._third()

    def _variables(self) -> list[tuple[str, str]]:
        """Attributes that both versions have, and the start value, of every variable."""
        found = []
        for k, (kind, signal) in enumerate((*self.inputs, *self.outputs)):
            is_input = k < len(self.inputs)
            # What a state starts with may be set; an action follows from the observation.
            initial = "" if is_input else ' initial="exact"' if kind == "state" else ' initial="calculated"'
            start = f' start="{self.values[k]!r}"' if is_input or kind == "state" else ""
            found.append(
                (
                    f'name={quoteattr(f"{kind}.{signal.name}")} valueReference="{k}" '
                    f'causality="{"input" if is_input else "output"}" variability="continuous"{initial} '
                    f"description={quoteattr(signal.unit)}",
                    start,
                )
            )
        return found

    def _second(self) -> str:
        rows = "".join(f"<ScalarVariable {row}><Real{start}/></ScalarVariable>" for row, start in self._variables())
        first, kinds = len(self.inputs) + 1, [kind for kind, _ in self.outputs]
        unknowns = "".join(f'<Unknown index="{first + k}"/>' for k in range(len(kinds)))
        calculated = "".join(f'<Unknown index="{first + k}"/>' for k, kind in enumerate(kinds) if kind != "state")
        initials = f"<InitialUnknowns>{calculated}</InitialUnknowns>" if calculated else ""
        return (
            f'{HEAD}<fmiModelDescription fmiVersion="2.0" modelName={quoteattr(self.name)} guid="{self.token}" {TOOL}>'
            f'<CoSimulation modelIdentifier="{self.name}" canHandleVariableCommunicationStepSize="true"/>'
            f'<DefaultExperiment startTime="0" stepSize="{self.dt!r}"/><ModelVariables>{rows}</ModelVariables>'
            f"<ModelStructure><Outputs>{unknowns}</Outputs>{initials}</ModelStructure></fmiModelDescription>\n"
        )

    def _third(self) -> str:
        rows = "".join(f"<Float64 {row}{start}/>" for row, start in self._variables())
        rows += f'<Float64 name="time" valueReference="{len(self.values)}" causality="independent" description="s"/>'
        first, kinds = len(self.inputs), [kind for kind, _ in self.outputs]
        outputs = "".join(f'<Output valueReference="{first + k}"/>' for k in range(len(kinds)))
        initials = "".join(
            f'<InitialUnknown valueReference="{first + k}"/>' for k, kind in enumerate(kinds) if kind != "state"
        )
        return (
            f'{HEAD}<fmiModelDescription fmiVersion="3.0" modelName={quoteattr(self.name)} '
            f'instantiationToken="{self.token}" {TOOL}>'
            f'<CoSimulation modelIdentifier="{self.name}" canHandleVariableCommunicationStepSize="true"/>'
            f'<DefaultExperiment startTime="0" stepSize="{self.dt!r}"/><ModelVariables>{rows}</ModelVariables>'
            f"<ModelStructure>{outputs}{initials}</ModelStructure></fmiModelDescription>\n"
        )


HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'
TOOL = 'generationTool="rt_torchrl" variableNamingConvention="structured"'


def build_description(name: str, source: str) -> str:
    """The content of ``buildDescription.xml``, with which FMI 3.0 says how the library is made of its source."""
    return (
        f'{HEAD}<fmiBuildDescription fmiVersion="3.0"><BuildConfiguration modelIdentifier="{name}">'
        f'<SourceFileSet language="C99"><SourceFile name="{source}"/></SourceFileSet></BuildConfiguration>'
        "</fmiBuildDescription>\n"
    )


def binaries(version: str) -> str:
    """Folder of the library for this machine."""
    system = SYSTEMS.get(sys.platform, "linux")
    if version == "2.0":
        return f"{'win' if system == 'windows' else system}{platform.architecture()[0].removesuffix('bit')}"
    machine = platform.machine().lower()
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
    return f"{machine}-{system}"
