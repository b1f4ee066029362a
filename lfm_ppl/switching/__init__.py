"""Linear models with a discrete input under a known rule."""
