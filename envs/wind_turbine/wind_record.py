"""Wind at the hub over time, as a simulator wrote it or a sensor measured it."""

from dataclasses import dataclass

import numpy as np

from rt_torchrl.options import array_of

PRINTED_TIME_RESOLUTION = 1e-3
"""Resolution of the times in a ``.hh`` file [s]; TurbSim prints them as F8.3."""
GREATEST_SPEED = 200.0
"""Speed above which a record cannot be of wind [m/s]; tornadoes, the strongest winds on Earth, reach about 140 m/s."""


@dataclass(frozen=True, eq=False)
class WindRecord:
    """Longitudinal wind at the hub at evenly spaced times; the arrays are copied and made read-only.

    Args:
        time: sample times [s], a vector of n, which increase by equal steps to within the 1 ms that TurbSim prints.
        speed: longitudinal wind speed u [m/s], a vector of n, from 0 to ``GREATEST_SPEED``.
        source: origin of the record, such as the path of the file; every error names it.

    Raises:
        ValueError: if there are fewer than two samples, the lengths differ, a value is NaN or infinite, a time does not
            increase, samples are missing, steps are unequal, or a speed is out of its range.
    """

    time: np.ndarray
    speed: np.ndarray
    source: str

    def __post_init__(self) -> None:
        for field in ("time", "speed"):
            array = array_of(f"{self.source}: {field}", getattr(self, field))
            array.setflags(write=False)
            object.__setattr__(self, field, array)
        self._check_shapes()
        self._check_speed()
        self._check_time()

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def step(self) -> float:
        """Mean sampling interval [s], which averages out the rounding of printed times."""
        return self.duration / (len(self.time) - 1)

    def _check_shapes(self) -> None:
        if self.time.ndim != 1 or self.time.shape != self.speed.shape:
            raise ValueError(
                f"{self.source}: time has shape {self.time.shape} and speed {self.speed.shape}; "
                "pass two vectors of equal length."
            )
        if len(self.time) < 2:
            raise ValueError(
                f"{self.source}: holds {len(self.time)} wind samples, at least 2 are needed; "
                "check that the file was written to its end."
            )

    def _check_speed(self) -> None:
        if (bad := np.flatnonzero(~np.isfinite(self.time))).size:
            raise ValueError(
                f"{self.source}: time of sample {bad[0]} is {self.time[bad[0]]}; all must be finite. "
                "Write the file again."
            )
        if (bad := np.flatnonzero(~np.isfinite(self.speed))).size:
            raise ValueError(
                f"{self.source}: wind speed at t = {self.time[bad[0]]:g} s is {self.speed[bad[0]]} "
                f"({bad.size} such samples); all must be finite. Fill the gap by interpolation or cut the record there."
            )
        if (bad := np.flatnonzero(self.speed < 0)).size:
            raise ValueError(
                f"{self.source}: wind speed at t = {self.time[bad[0]]:g} s is {self.speed[bad[0]]:g} m/s; it must "
                "not be negative. Check its sign and the wind direction, which is 0 deg along the rotor axis."
            )

        if (bad := np.flatnonzero(self.speed > GREATEST_SPEED)).size:
            raise ValueError(
                f"{self.source}: wind speed at t = {self.time[bad[0]]:g} s is {self.speed[bad[0]]:g} m/s; it must "
                f"not exceed {GREATEST_SPEED:g} m/s. Check its unit, and that the file is whole."
            )

    def _check_time(self) -> None:
        steps = np.diff(self.time)
        if (bad := np.flatnonzero(steps <= 0)).size:
            raise ValueError(
                f"{self.source}: time goes from {self.time[bad[0]]:g} s to {self.time[bad[0] + 1]:g} s; it must "
                "increase. Sort the samples and drop repeated ones."
            )
        step = float(np.median(steps))
        # Two times rounded to 1 ms give a step that is off by up to 1 ms; below 2 ms this would hide a missing sample.
        tolerance = min(1.01 * PRINTED_TIME_RESOLUTION, 0.5 * step)
        if not (bad := np.flatnonzero(np.abs(steps - step) > tolerance)).size:
            return
        where, found = self.time[bad[0]], steps[bad[0]]
        if found > 1.5 * step:
            raise ValueError(
                f"{self.source}: gap after t = {where:g} s, where {round(found / step) - 1} samples are missing (step "
                f"{found:g} s instead of {step:g} s). Fill it by interpolation or cut the record there."
            )
        raise ValueError(
            f"{self.source}: unequal time step after t = {where:g} s, {found:g} s instead of {step:g} s. "
            "Resample the record to equal steps."
        )
