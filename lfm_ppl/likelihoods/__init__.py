"""The likelihood of a model as a NumPyro distribution, and the effect handlers that act on it."""
