"""The iterations of DDPG with gradients by formula: the results of TorchRL's losses without their overhead."""
