"""Lets a checkout import the folder ``envs`` beside this package as ``rt_torchrl.envs``; a wheel holds the folder."""

from pathlib import Path

__path__ = [str(Path(__file__).resolve().parent.parent / "envs")]
