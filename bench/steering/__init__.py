"""The latent-noise environment, evaluation in it, and the seeds of episodes."""
