"""What a policy is trained on: data, target, optimiser."""
