"""The latent force model, what it observes, and its conversion to a state-space model."""
