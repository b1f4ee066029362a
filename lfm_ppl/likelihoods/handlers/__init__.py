"""Effect handlers: what is done to a NumPyro model with a likelihood site before it runs."""
