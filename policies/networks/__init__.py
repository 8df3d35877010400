"""Networks that policies are made of: dense equivariant layers and networks for one slice."""
