"""The iterations of step 2 with gradients by formula: the results of TorchRL's losses without their overhead."""
