"""How a policy is made symmetric: one file for each way, with its policy."""
