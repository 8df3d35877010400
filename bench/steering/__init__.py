"""The latent-noise environment, evaluation in it and the collect/update loop."""
