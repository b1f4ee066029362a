"""The latent force model, its observations and events, its state-space form, and simulation of it."""
