"""The model contract, triplets, the label budget, the training loop, checkpoints."""
