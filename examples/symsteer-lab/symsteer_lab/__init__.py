"""An agent, a policy, a variant and a task for SymSteer."""
