"""Run configuration, run folder, checkpoints, records and TensorBoard."""
