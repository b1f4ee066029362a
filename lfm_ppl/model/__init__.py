"""The latent force model, its observations, and its conversion to a state-space model."""
