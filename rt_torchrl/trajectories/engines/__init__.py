"""Four gradient engines for one trajectory: see :mod:`rt_torchrl.trajectories.rollout`."""
